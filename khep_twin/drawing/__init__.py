"""Pictures of playpens: maps to scale, light on the floor, perspective views."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.drawing.map import draw as draw
    from khep_twin.drawing.map import picture as picture
    from khep_twin.drawing.map import save as save
    from khep_twin.drawing.map import thumbnail as thumbnail
    from khep_twin.drawing.paths import DrawnPath as DrawnPath
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
