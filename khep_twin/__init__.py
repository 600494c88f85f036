"""A physics-based digital twin of the Khepera miniature robot.

Importing this package registers the port `khep://` with pyserial and has no other effect.
"""

import serial

__version__ = "0.1.0"

if "khep_twin.ports" not in serial.protocol_handler_packages:
    serial.protocol_handler_packages.append("khep_twin.ports")
