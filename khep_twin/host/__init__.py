"""Programs that talk to a Khepera, real or simulated. Loads no simulator."""

from khep_twin.host.gripper import Gripper as Gripper
from khep_twin.host.khepera import Khepera as Khepera
