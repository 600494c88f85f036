"""Ports of a twin: khep:// in the host's process; pseudo-terminals and TCP ports for other programs."""

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.ports.network import TcpPort as TcpPort
    from khep_twin.ports.protocol_khep import Serial as Serial
    from khep_twin.ports.twin import Twin as Twin
    from khep_twin.ports.twin import TwinOptions as TwinOptions
    from khep_twin.ports.twin import open_twin as open_twin

    if sys.platform != "win32":
        from khep_twin.ports.pty import PtyPort as PtyPort
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
