"""Fit of wheels from drives and a ruler: the hidden values of a twin are recovered."""

import math
from pathlib import Path

import pytest
from command_line import good
from test_robot_fit import Bench

from khep_twin.errors import FitError
from khep_twin.lab.fit.wheel_fit import Drive, drive_residual, fit_wheels, read_pulses
from khep_twin.sensing import calibration


def test_hidden_wheels_are_found_an_unused_drive_is_met_and_a_twin_can_use_the_calibration(
    tmp_path: Path,
) -> None:
    bench, target = Bench(tmp_path), tmp_path / "mine.toml"
    straight, spin, arc = (tmp_path / f"{name}.mcap" for name in ("straight", "spin", "other"))
    distance, _ = bench.drive(straight.name, 10_000, 10_000)
    _, turned = bench.drive(spin.name, -10_000, 10_000)
    other, _ = bench.drive(arc.name, 6_000, 6_000)
    # A person reads full millimetres and tenths of a turn.
    _, (radius, base) = fit_wheels(
        [
            Drive("straight", *read_pulses(straight), distance=round(distance, 3)),
            Drive("spin", *read_pulses(spin), turn=turned),
        ]
    )
    assert radius.value == pytest.approx(7.83, rel=0.002)
    assert base.value == pytest.approx(53.4, rel=0.005)
    assert abs(radius.value - 7.83) < radius.interval + 7.83 * 0.001
    left = drive_residual(
        Drive("other", *read_pulses(arc), distance=other), radius.value / 1e3, base.value / 1e3
    )
    assert abs(left) < 0.002
    words = [f"{straight}={distance * 1000:.0f}mm", f"{spin}={turned / 2 / math.pi:.3f}turns"]
    assert "not used for the fit" in good("fit", *words, "--check", words[0], "-o", target)
    written = calibration.read(str(target))[0]
    assert written.name == "mine"
    assert written.wheels.radius_mm == pytest.approx(7.83, rel=0.003)
    assert written.proximity == calibration.read("khepera1")[0].proximity


STRAIGHT, SPIN = Drive("straight", 12500, 12500, distance=1.0), Drive("spin", -5000, 5000, turn=15.4)


@pytest.mark.parametrize(
    ("drives", "message"),
    [
        ([STRAIGHT], "the wheel base cannot be determined"),
        ([SPIN], "the wheels' radius cannot be determined"),
        ([Drive("short", 100, 100, distance=0.01), SPIN], "the wheels' radius cannot be determined"),
        ([STRAIGHT, Drive("little", -100, 100, turn=0.2)], "the wheel base cannot be determined"),
        ([Drive("inches", 12500, 12500, distance=39.4), SPIN], "are not a Khepera's"),
    ],
)
def test_drives_that_cannot_tell_are_refused_by_name(drives: list[Drive], message: str) -> None:
    with pytest.raises(FitError, match=message):
        fit_wheels(drives)


def test_contradicting_drives_widen_the_interval() -> None:
    again = Drive("again", 12500, 12500, distance=1.02)
    wide, narrow = (fit_wheels(drives)[1][0] for drives in ([STRAIGHT, again, SPIN], [STRAIGHT, SPIN]))
    assert wide.interval > 5 * narrow.interval
