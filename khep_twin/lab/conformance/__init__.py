"""Checks of the protocol on any port."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.lab.conformance.port.conform import ConformanceReport as ConformanceReport
    from khep_twin.lab.conformance.port.conform import conform as conform
    from khep_twin.lab.conformance.recording.conform import RecordingReport as RecordingReport
    from khep_twin.lab.conformance.recording.conform import conform_recording as conform_recording
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
