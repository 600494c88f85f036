"""MAT files without machine name and time: the same variables give the same bytes."""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false

from collections.abc import Mapping
from io import BytesIO

from khep_twin import __version__

_TITLE_BYTES = 116


def mat_bytes(values: Mapping[str, object], what: str, *, packed: bool = True) -> bytes:
    """Return variables as a MAT file of Matlab 5.

    Args:
        values: Variables by names that Matlab accepts.
        what: Description of the file for its title.
        packed: True to compress by zlib.
    """
    # Every run could save a series; to import scipy would take a fifth of a short run's start.
    from scipy.io import savemat

    file = BytesIO()
    savemat(file, dict(values), do_compression=packed)
    # scipy writes the machine and the time here.
    title = f"MATLAB 5.0 MAT-file, {what} by khep_twin {__version__}".encode("ascii")
    return title.ljust(_TITLE_BYTES) + file.getvalue()[_TITLE_BYTES:]
