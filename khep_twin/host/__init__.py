"""Programs that talk to a Khepera, real or simulated. Loads no simulator."""

from khep_twin.host import commands as commands
from khep_twin.host.gripper import Gripper as Gripper
from khep_twin.host.khepera import Khepera as Khepera
from khep_twin.host.results import MotionStatus as MotionStatus
from khep_twin.host.results import MotorMode as MotorMode
from khep_twin.host.results import Positions as Positions
from khep_twin.host.results import SensorCounts as SensorCounts
from khep_twin.host.results import Speeds as Speeds
from khep_twin.host.results import Versions as Versions
from khep_twin.host.results import WheelStatus as WheelStatus
from khep_twin.host.vision import Vision as Vision
from khep_twin.units import Sensor as Sensor
