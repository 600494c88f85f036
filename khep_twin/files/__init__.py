"""Users' files: atomic writing, TOML editing that keeps comments, MAT and NPZ files."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.files.atomic import unusable as unusable
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
