"""The pair of mujoco and dm-control, which are released together and fail on each other's wrong release."""

from importlib import metadata

from khep_twin.errors import KhepTwinError

MUJOCO, DM_CONTROL = "3.17", "1.0.50"
"""The releases of mujoco, any of that series, and of dm-control that work together."""


def problem(mujoco: str, dm_control: str) -> str:
    """What is wrong with a pair of versions, in a line; empty if they work together.

    dm-control 1.0.50 is made for mujoco 3.17; on mujoco 4.0.0 its physics fails by an AttributeError.
    """
    if f"{mujoco}.".startswith(f"{MUJOCO}.") and dm_control == DM_CONTROL:
        return ""
    return (
        f"mujoco {mujoco} and dm-control {dm_control} are not known to work together; right is: "
        f"pip install 'mujoco~={MUJOCO}.0' 'dm-control=={DM_CONTROL}'"
    )


def check() -> None:
    """Looks at what is installed.

    Raises:
        KhepTwinError: that is not the pair known to work.
    """
    if text := problem(metadata.version("mujoco"), metadata.version("dm-control")):
        raise KhepTwinError(text)
