"""Programs that talk to a Khepera, real or simulated. Loads no simulator."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.host import commands as commands
    from khep_twin.host.discovery import FoundPort as FoundPort
    from khep_twin.host.discovery import found_ports as found_ports
    from khep_twin.host.gripper import Gripper as Gripper
    from khep_twin.host.host_robot import HostRobot as HostRobot
    from khep_twin.host.khepera import Khepera as Khepera
    from khep_twin.host.moves import turn_pulses as turn_pulses
    from khep_twin.host.moves import way_pulses as way_pulses
    from khep_twin.host.profile_robot import ProfileRobot as ProfileRobot
    from khep_twin.host.radio import Radio as Radio
    from khep_twin.host.radio import RadioMessage as RadioMessage
    from khep_twin.host.results import Battery as Battery
    from khep_twin.host.results import Distances as Distances
    from khep_twin.host.results import MotionStatus as MotionStatus
    from khep_twin.host.results import MotorMode as MotorMode
    from khep_twin.host.results import Positions as Positions
    from khep_twin.host.results import SensorCounts as SensorCounts
    from khep_twin.host.results import Speeds as Speeds
    from khep_twin.host.results import Versions as Versions
    from khep_twin.host.results import Wheels as Wheels
    from khep_twin.host.results import WheelStatus as WheelStatus
    from khep_twin.host.vision import Vision as Vision
    from khep_twin.host.vision import read_image as read_image
    from khep_twin.host.vision import read_light as read_light
    from khep_twin.host.vision import read_region as read_region
    from khep_twin.robots.khepera4.host import InfraredCounts as InfraredCounts
    from khep_twin.robots.khepera4.host import Khepera4 as Khepera4
    from khep_twin.robots.khepera4.host import Vector3 as Vector3
    from khep_twin.units import RadioStatus as RadioStatus
    from khep_twin.units import Sensor as Sensor
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__, "robots/*/__init__.py")
