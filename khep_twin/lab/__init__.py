"""Experiments with a robot or a twin, on any port."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.lab import challenge as challenge
    from khep_twin.lab import conformance as conformance
    from khep_twin.lab import dataset as dataset
    from khep_twin.lab import experiment as experiment
    from khep_twin.lab import fit as fit
    from khep_twin.lab import report as report
    from khep_twin.lab import sensor_test as sensor_test
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
