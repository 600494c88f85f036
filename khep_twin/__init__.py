"""A physics-based digital twin of the Khepera miniature robot.

Importing this package registers the port `khep://` with pyserial, and the environments with Gymnasium if that
is loaded, or when it is; it has no other effect.
"""

from typing import TYPE_CHECKING

import serial

from khep_twin.envs.registration import register as _register

if TYPE_CHECKING:
    from khep_twin import board as board
    from khep_twin import drawing as drawing
    from khep_twin import envs as envs
    from khep_twin import episodes as episodes
    from khep_twin import errors as errors
    from khep_twin import host as host
    from khep_twin import lab as lab
    from khep_twin import log as log
    from khep_twin import playpen as playpen
    from khep_twin import ports as ports
    from khep_twin import sensing as sensing
    from khep_twin import shadow as shadow
    from khep_twin import sweep as sweep
    from khep_twin import toolbox as toolbox
    from khep_twin import units as units
    from khep_twin.drawing.map import draw as draw
    from khep_twin.envs.gymnasium import make as make
    from khep_twin.envs.gymnasium import make_vec as make_vec
    from khep_twin.episodes.batch import RolloutResult as RolloutResult
    from khep_twin.episodes.batch import rollout as rollout
    from khep_twin.episodes.controllers import Braitenberg as Braitenberg
    from khep_twin.episodes.controllers import ConstantSpeed as ConstantSpeed
    from khep_twin.episodes.controllers import Function as Function
    from khep_twin.episodes.controllers import Network as Network
    from khep_twin.episodes.controllers import Policy as Policy
    from khep_twin.episodes.episode import Episode as Episode
    from khep_twin.episodes.episode_options import EpisodeOptions as EpisodeOptions
    from khep_twin.episodes.episode_setup import EpisodeSetup as EpisodeSetup
    from khep_twin.episodes.line import MeasuredCycle as MeasuredCycle
    from khep_twin.errors import KhepTwinError as KhepTwinError
    from khep_twin.errors import MoveError as MoveError
    from khep_twin.errors import PlaypenError as PlaypenError
    from khep_twin.errors import PortError as PortError
    from khep_twin.errors import PortTimeout as PortTimeout
    from khep_twin.host.gripper import Gripper as Gripper
    from khep_twin.host.khepera import Khepera as Khepera
    from khep_twin.host.radio import Radio as Radio
    from khep_twin.host.vision import Vision as Vision
    from khep_twin.lab.experiment.controllers import Controller as Controller
    from khep_twin.lab.experiment.periodic_controllers import NetworkController as NetworkController
    from khep_twin.lab.experiment.task_controller import TaskController as TaskController
    from khep_twin.log.reader import LoggedRun as LoggedRun
    from khep_twin.log.reader import read_log as read_log
    from khep_twin.playpen.model import Playpen as Playpen
    from khep_twin.playpen.parts import Lamp as Lamp
    from khep_twin.playpen.starts import Start as Start
    from khep_twin.ports.serve import serve as serve
    from khep_twin.ports.twin import Twin as Twin
    from khep_twin.ports.twin import TwinOptions as TwinOptions
    from khep_twin.ports.twin import open_twin as open_twin
    from khep_twin.robots.khepera4.host import Khepera4 as Khepera4
    from khep_twin.shadow.shadow import Shadow as Shadow
    from khep_twin.units import Sensor as Sensor
    from khep_twin.web.run_page import RunPage as RunPage
    from khep_twin.world import World as World
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__, "robots/*/__init__.py")

__version__ = "1.0.0"

if "khep_twin.ports" not in serial.protocol_handler_packages:
    serial.protocol_handler_packages.append("khep_twin.ports")
_register()
