"""Studies: many episodes in parallel, in threads or in worker processes that may die."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.sweep.ray_workers import on_ray as on_ray
    from khep_twin.sweep.study import Study as Study
    from khep_twin.sweep.study import load as load
    from khep_twin.sweep.sweep import run_locally as run_locally
    from khep_twin.sweep.sweep import run_sweep as run_sweep
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
