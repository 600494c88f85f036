"""The robot's electronics without input or output: protocol, kernel, ROMs, serial controller, turrets."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.board.fault_injection import Fault as Fault
    from khep_twin.board.fault_injection import parse_fault as parse_fault
    from khep_twin.board.kernel import AMBIENT as AMBIENT
    from khep_twin.board.kernel import DEMO_DIVISOR as DEMO_DIVISOR
    from khep_twin.board.kernel import DEMO_SPEED_PULSES as DEMO_SPEED_PULSES
    from khep_twin.board.kernel import DEMO_WEIGHTS as DEMO_WEIGHTS
    from khep_twin.board.kernel import PROXIMITY as PROXIMITY
    from khep_twin.board.kernel import SETPOINTS as SETPOINTS
    from khep_twin.board.protocol import Malformed as Malformed
    from khep_twin.board.protocol import parse_turret_order as parse_turret_order
    from khep_twin.board.protocol import turret_reply as turret_reply
    from khep_twin.board.rom import ROMS as ROMS
    from khep_twin.board.terms import Term as Term
    from khep_twin.board.turrets import Turret as Turret
    from khep_twin.board.turrets import TurretBody as TurretBody
    from khep_twin.board.turrets import TurretContext as TurretContext
    from khep_twin.board.turrets import TurretKind as TurretKind
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
