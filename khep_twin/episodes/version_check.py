"""Check of the versions of mujoco and dm-control, which work only in matching releases."""

from importlib import metadata

from khep_twin.errors import KhepTwinError, pip_install

MUJOCO, DM_CONTROL = "3.17", "1.0.50"
"""Releases of mujoco, any of that series, and of dm-control that work together."""


def find_problem(mujoco: str, dm_control: str | None) -> str:
    """Return why two versions do not work together, in one line; empty if they do.

    dm-control 1.0.50 is made for mujoco 3.17; with mujoco 4.0.0 its physics raises an AttributeError.

    Args:
        mujoco: Version of mujoco.
        dm_control: Version of dm-control; None if it is not installed.
    """
    if f"{mujoco}.".startswith(f"{MUJOCO}.") and dm_control == DM_CONTROL:
        return ""
    if dm_control is None:
        problem_text = (
            "dm-control is not installed; pip leaves it out from Python 3.13 on, where labmaze, which it "
            "requires and does not need here, has no wheel"
        )
    else:
        problem_text = f"mujoco {mujoco} and dm-control {dm_control} are not known to work together"
    # Without dependencies, as pip would search for labmaze; khep_twin depends on the required ones.
    remedy = pip_install("--no-deps", f"mujoco~={MUJOCO}.0", f"dm-control=={DM_CONTROL}")
    return f"{problem_text}; to install them: {remedy}"


def check() -> None:
    """Check the installed versions.

    Raises:
        KhepTwinError: The versions are not known to work together.
    """
    try:
        dm_control = metadata.version("dm-control")
    except metadata.PackageNotFoundError:
        dm_control = None
    if text := find_problem(metadata.version("mujoco"), dm_control):
        raise KhepTwinError(text)
