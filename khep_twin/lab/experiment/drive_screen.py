"""Terminal screen for driving a robot by hand, as plain lines of characters."""

from khep_twin.host import SensorCounts
from khep_twin.lab.experiment.teleoperation import DriveView
from khep_twin.sensing.bars import BARS
from khep_twin.units import speed

WIDTH, HEIGHT = 64, 18
"""Size of the smallest terminal [characters]."""

_NAMES = [name.replace("_", " ") for name in SensorCounts._fields]
_LABEL, _COUNTS, _GAP = 12, 5, 3
_ON = ("off", "on")

KEYS = (
    "arrows or WASD drive while held   space stops   q ends",
    "+ - or 1 to 9 choose the speed    L switches the LEDs",
)


def draw(view: DriveView, name: str, width: int, height: int) -> list[str]:
    """Return the lines of the screen, of at most `width` characters."""
    if width < WIDTH or height < HEIGHT:
        line = f"{width} x {height} characters; expected at least {WIDTH} x {HEIGHT}; q ends"
        return [line[: max(width - 1, 0)]]
    bar = (width - _LABEL - 2 * _COUNTS - _GAP - 1) // 2
    left, right = (1e3 * speed(pulses) for pulses in view.measured)
    supply = "" if view.supply is None else f"   supply about {view.supply:.1f} V"
    lost = f"   {view.lost} replies lost" if view.lost else ""
    column = bar + _COUNTS + _GAP
    lines = [
        f"khep-twin drive  {name}",
        "",
        f"{'':{_LABEL}}{'proximity':{column}}{BARS['light'].legend}",
        *(
            f"{sensor:{_LABEL}}"
            f"{_bar('proximity', near, bar)}{near:{_COUNTS}}{'':{_GAP}}"
            f"{_bar('light', dark, bar)}{dark:{_COUNTS}}"
            for sensor, near, dark in zip(_NAMES, view.proximity, view.ambient, strict=True)
        ),
        "",
        f"{'wheels':{_LABEL}}left {view.measured.left:4}  right {view.measured.right:4} pulses/10 ms"
        f"   ({left:.0f}, {right:.0f} mm/s)",
        f"{'drives':{_LABEL}}{view.direction.name.lower()}, speed {view.speed}{lost}",
        f"{'LEDs':{_LABEL}}lateral {_ON[view.leds[0]]:3}  frontal {_ON[view.leds[1]]:3}{supply}",
        "",
        *KEYS,
    ]
    return [line[: width - 1] for line in lines]


def _bar(name: str, value: float, width: int) -> str:
    """Return a bar of this many characters, filled by a value."""
    full = round(BARS[name].filled(value) * width)
    return "#" * full + "." * (width - full)
