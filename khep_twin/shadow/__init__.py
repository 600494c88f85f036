"""Estimates a robot's pose and its faults from the bytes of its line."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.shadow.shadow import Shadow as Shadow
    from khep_twin.shadow.shadow import ShadowSettings as ShadowSettings
    from khep_twin.shadow.update import Update as Update
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
