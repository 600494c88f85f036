"""Infrared sensors of the Khepera IV: eight around and four for the floor, by the law of `sensing.ground`."""

from collections.abc import Sequence

from khep_twin.board.memory import read_signed, write_number
from khep_twin.compilable import compilable
from khep_twin.robots.khepera4.registers import DspicRegister
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.device_faults import DeviceFaults, sensor_reading
from khep_twin.sensing.ground import Ground, convert_any
from khep_twin.sensing.light import Light
from khep_twin.sensing.noise import Tables, draws
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import BeamScene

PERIOD_NS = 5_000_000
"""Period of the measurements [ns] (manual)."""

HEIGHT, LENS = 0.0047, 0.002
"""Height of the ground sensors above the floor (manual), and length of their lens (assumed) [m]."""

_PROXIMITY, _AMBIENT = int(DspicRegister.PROXIMITY), int(DspicRegister.AMBIENT)


@compilable
def measure(
    scene: BeamScene,
    sensors: RobotSensors,
    faults: DeviceFaults,
    ground: Ground,
    light: Light,
    powers: Sequence[float],
    tables: Tables,
    key: Vector[int],
    time_ns: int,
    memory: Vector[int],
) -> None:
    """Set the registers of all sensors.

    Args:
        scene: BeamScene at the time of the measurement.
        sensors: Sensors of the robot.
        faults: Their faults.
        ground: Those that look at the floor.
        light: Lamps of the world.
        powers: Powers of the lamps (n,) [W].
        tables: Quantiles of random draws.
        key: Words of the key of the robot's random draws (2,).
        time_ns: Time of the measurement [ns].
        memory: Memory of the dsPIC.
    """
    n_sensors = len(sensors.cameras)
    first_draw = time_ns // PERIOD_NS * n_sensors
    for channel in range(n_sensors):
        noise = draws(tables, key, first_draw + channel)
        reflected, ambient = convert_any(scene, sensors, ground, light, powers, time_ns, channel, noise)
        for word, reading, dead in ((_PROXIMITY, reflected, 0), (_AMBIENT, ambient, ground.darkest)):
            start = word + 2 * channel
            last = read_signed(memory, start, 2)
            write_number(memory, start, 2, sensor_reading(faults, channel, reading, last, dead))
