"""Body of a model of robot: its size, mass, wheels, and the positions of its sensors."""

import math
from dataclasses import dataclass

PER_METRE = {"m": 1, "cm": 100, "mm": 1000}
"""Units of ultrasonic readings, per metre."""


@dataclass(frozen=True, slots=True)
class SonarRing:
    """Ultrasonic sensors around the robot's centre, which look outwards.

    Attributes:
        names: Names of the sensors, in the order of the channel "ultrasonic".
        headings_deg: Heading of each sensor.
        radius: Distance of the sensors from the centre [m]; not used with `positions`.
        height: Height of the sensors above the ground [m].
        codes: Readings without a distance: too near, no echo, disabled.
        lag: Mean age of a distance when it is read [s].
        positions: Positions of the sensors, x forward and y left of the centre [m]; empty if they lie on a
            circle, each in the direction of its heading.
        nearest: Shortest measured distance [m].
        reach: Longest measured distance [m].
        exponent: Exponent of the cosine off the axis, of the beam's amplitude; 0 for an unknown one.
    """

    names: tuple[str, ...]
    headings_deg: tuple[float, ...]
    radius: float
    height: float
    codes: tuple[int, ...]
    lag: float = 0.0
    positions: tuple[tuple[float, float], ...] = ()
    nearest: float = 0.0
    reach: float = math.inf
    exponent: float = 0.0

    @property
    def places(self) -> list[tuple[float, float, float, float]]:
        """Position x, y, z [m] and heading [rad] of each sensor on the robot."""
        headings = [math.radians(heading) for heading in self.headings_deg]
        circle = [(self.radius * math.cos(a), self.radius * math.sin(a)) for a in headings]
        pairs = zip(self.positions or circle, headings, strict=True)
        return [(x, y, self.height, heading) for (x, y), heading in pairs]


@dataclass(frozen=True, slots=True)
class Body:
    """Body of a model of robot.

    Attributes:
        radius: Radius [m].
        mass: Mass of the whole robot [kg].
        support_position: Distance of the sliding supports before and behind the centre [m].
        sensor_positions: Positions of the infrared sensors around the robot, x forward and y left of the
            centre (n, 2) [m].
        sensor_height: Height of these sensors above the ground [m].
        idle_current: Current with the motors at rest [A].
        height: Height [m].
        scene: MJCF file of the robot, in the folder of the shipped ones if it has no folder; `robots.to_mjcf`
            adds wheels, motors and infrared sensors that it lacks.
        sensors: Names of the infrared sensors, those that look at the floor last.
        wheel_radius: Radius of the wheels [m].
        wheel_width: Width of the wheels [m].
        wheel_base: Distance of the wheels [m].
        pulses_per_turn: Pulses of an encoder in a turn of its wheel.
        near_counts: Proximity above which something is near [counts].
        support_solref: Contact of the supports with the floor, as MuJoCo's `solref`; None for stiff ones.
        fits_scene: True if the file has another size of the robot, and this body sets it; e.g. for
            "two_wheels.xml".
        ground_positions: Positions of the sensors that look at the floor, as `sensor_positions`.
        ground_height: Height of these sensors above the ground [m].
        sonar: Ultrasonic sensors; None without.
        wheel_mass: Mass of a wheel that the file lacks [kg].
        rotor_inertia: Inertia of the motor's rotor seen at this wheel [kg m^2].
        voltage_limit: Largest voltage of its motor [V].
    """

    radius: float
    mass: float
    support_position: float
    sensor_positions: tuple[tuple[float, float], ...]
    sensor_height: float
    idle_current: float
    height: float
    scene: str
    sensors: tuple[str, ...]
    wheel_radius: float
    wheel_width: float
    wheel_base: float
    pulses_per_turn: float
    near_counts: int
    support_solref: tuple[float, float] | None = None
    fits_scene: bool = False
    ground_positions: tuple[tuple[float, float], ...] = ()
    ground_height: float = 0.0
    sonar: SonarRing | None = None
    wheel_mass: float = 0.01
    rotor_inertia: float = 1e-5
    voltage_limit: float = 6.0

    @property
    def ring_sensors(self) -> tuple[str, ...]:
        """Names of the infrared sensors around the robot."""
        return self.sensors[: len(self.sensor_positions)]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of its infrared sensors in its scene."""
        return tuple(name.replace(" ", "_") for name in self.sensors)

    @property
    def sensor_places(self) -> list[tuple[float, float, float]]:
        """Positions of its infrared sensors [m], in the order of their names."""
        ring = [(x, y, self.sensor_height) for x, y in self.sensor_positions]
        return ring + [(x, y, self.ground_height) for x, y in self.ground_positions]

    @property
    def fault_sensors(self) -> tuple[str, ...]:
        """Names of its sensors in faults, by their numbers: the infrared, then the ultrasonic ones."""
        ultrasonic = () if self.sonar is None else self.sonar.names
        names = [f"proximity {name}" for name in self.sensors] + [f"ultrasonic {name}" for name in ultrasonic]
        return tuple(name.replace(" ", "_") for name in names)

    @property
    def pulse_length(self) -> float:
        """Travel of a wheel per pulse [m]."""
        return self.wheel_radius * 2 * math.pi / self.pulses_per_turn
