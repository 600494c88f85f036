"""Check of the versions of mujoco and dm-control, which work only in matching releases."""

from importlib import metadata

from khep_twin.errors import KhepTwinError, pip_install

MUJOCO, DM_CONTROL = "3.17", "1.0.50"
"""Releases of mujoco, any of that series, and of dm-control that work together."""


def problem(mujoco: str, dm_control: str | None) -> str:
    """Return what is wrong with a pair of versions, in a line; empty if they work together.

    dm-control 1.0.50 is made for mujoco 3.17; on mujoco 4.0.0 its physics fails by an AttributeError.

    Args:
        mujoco: Version of mujoco.
        dm_control: Version of dm-control; None if it is not installed.
    """
    if f"{mujoco}.".startswith(f"{MUJOCO}.") and dm_control == DM_CONTROL:
        return ""
    if dm_control is None:
        found = (
            "dm-control is not installed; pip leaves it out from Python 3.13 on, where labmaze, which it "
            "requires and does not need here, has no wheel"
        )
    else:
        found = f"mujoco {mujoco} and dm-control {dm_control} are not known to work together"
    # Without dependencies, as pip would look for labmaze; khep_twin requires those that are needed.
    remedy = pip_install("--no-deps", f"mujoco~={MUJOCO}.0", f"dm-control=={DM_CONTROL}")
    return f"{found}; to install them: {remedy}"


def check() -> None:
    """Check the versions that are installed.

    Raises:
        KhepTwinError: The versions are not known to work together.
    """
    try:
        dm_control = metadata.version("dm-control")
    except metadata.PackageNotFoundError:
        dm_control = None
    if text := problem(metadata.version("mujoco"), dm_control):
        raise KhepTwinError(text)
