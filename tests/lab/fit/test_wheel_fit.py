"""Wheels from drives and a ruler: what a twin with other wheels was made with is found."""

import math
from pathlib import Path

import pytest
from command_line import khep_twin

from khep_twin import playpen
from khep_twin.errors import FitError
from khep_twin.files.toml_files import dump
from khep_twin.host import Khepera
from khep_twin.lab.fit.wheel_fit import Drive, fit_wheels, left_over, pulses
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.sensing import calibration


@pytest.fixture
def hidden(tmp_path: Path) -> str:
    """A playpen whose robot has its own wheels."""
    other = calibration.read("khepera1")[0].model_copy(
        update={"wheels": calibration.WheelCalibration(radius_mm=7.83, base_mm=53.4)}
    )
    (tmp_path / "hidden.toml").write_text(dump(other))
    return (
        'version = 1\nname = "floor"\n[arena]\nwidth_mm = 3000\nheight_mm = 1000\n[[robot]]\nx_mm = 300\n'
        f'y_mm = 500\nheading_deg = 0\ncalibration = "{tmp_path / "hidden.toml"}"\n'
    )


def drive(text: str, log: Path, left: int, right: int) -> tuple[float, float]:
    """Lets the robot drive by position control, recorded; its true way [m] and turning [rad]."""
    twin = open_twin(playpen.parse(text, "floor"), TwinOptions(log=str(log)))
    with Khepera(Serial.of(twin, timeout=1.0)) as robot:
        body = twin.robot
        start, turned, heading = body.pose, 0.0, body.pose[2]
        robot.set_position(0, 0)
        robot.position()
        robot.set_target(left, right)
        while not all(wheel.on_target for wheel in robot.status()):
            turned += (body.pose[2] - heading + math.pi) % (2 * math.pi) - math.pi
            heading = body.pose[2]
        robot.sleep(0.5)
        robot.position()
        return math.dist(start[:2], body.pose[:2]), turned + body.pose[2] - heading


def test_hidden_wheels_are_found_and_an_unused_drive_is_met(hidden: str, tmp_path: Path) -> None:
    straight, spin, arc = (tmp_path / f"{name}.mcap" for name in ("straight", "spin", "other"))
    distance, _ = drive(hidden, straight, 12_500, 12_500)
    _, turned = drive(hidden, spin, -10_000, 10_000)
    other, _ = drive(hidden, arc, 6_000, 6_000)
    # As a person reads them: whole millimetres, tenths of a turn.
    found = fit_wheels(
        [
            Drive("straight", *pulses(straight), distance=round(distance, 3)),
            Drive("spin", *pulses(spin), turned=turned),
        ]
    )
    assert found.radius == pytest.approx(7.83e-3, rel=0.002)
    assert found.base == pytest.approx(53.4e-3, rel=0.005)
    assert abs(found.radius - 7.83e-3) < found.radius_interval + 7.83e-3 * 0.001
    left = left_over(Drive("other", *pulses(arc), distance=other), found.radius, found.base)
    assert abs(left) < 0.002


def test_the_command_writes_a_calibration_that_a_twin_can_use(hidden: str, tmp_path: Path) -> None:
    log, spin, target = tmp_path / "straight.mcap", tmp_path / "spin.mcap", tmp_path / "mine.toml"
    distance, _ = drive(hidden, log, 5_000, 5_000)
    _, turned = drive(hidden, spin, -4_000, 4_000)
    words = [f"{log}={distance * 1000:.0f}mm", f"{spin}={turned / 2 / math.pi:.3f}turns"]
    done = khep_twin("fit", *words, "--check", words[0], "-o", target)
    assert done.returncode == 0, done.stderr
    assert "not used for the fit" in done.stdout
    written = calibration.read(str(target))[0]
    assert written.name == "mine"
    assert written.wheels.radius_mm == pytest.approx(7.83, rel=0.003)
    assert written.proximity == calibration.read("khepera1")[0].proximity


STRAIGHT, SPIN = Drive("straight", 12500, 12500, distance=1.0), Drive("spin", -5000, 5000, turned=15.4)


@pytest.mark.parametrize(
    ("drives", "message"),
    [
        ([STRAIGHT], "the wheel base cannot be determined"),
        ([SPIN], "the wheels' radius cannot be determined"),
        ([Drive("short", 100, 100, distance=0.01), SPIN], "the wheels' radius cannot be determined"),
        ([STRAIGHT, Drive("little", -100, 100, turned=0.2)], "the wheel base cannot be determined"),
        ([Drive("inches", 12500, 12500, distance=39.4), SPIN], "are not a Khepera's"),
    ],
)
def test_drives_that_cannot_tell_are_refused_by_name(drives: list[Drive], message: str) -> None:
    with pytest.raises(FitError, match=message):
        fit_wheels(drives)


def test_contradicting_drives_widen_the_interval() -> None:
    again = Drive("again", 12500, 12500, distance=1.02)
    assert (
        fit_wheels([STRAIGHT, again, SPIN]).radius_interval > 5 * fit_wheels([STRAIGHT, SPIN]).radius_interval
    )


@pytest.mark.parametrize("words", ["a.mcap", "a.mcap=5", "a.mcap=5cm", "=5mm", "no-such.mcap=5mm"])
def test_words_that_make_no_drive_are_one_line(words: str) -> None:
    done = khep_twin("fit", words)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert words.partition("=")[0] in done.stderr
