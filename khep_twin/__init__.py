"""A physics-based digital twin of the Khepera miniature robot.

Importing this package teaches pyserial the port `khep://` and does nothing else.
"""

import serial

__version__ = "0.1.0"

if "khep_twin.ports" not in serial.protocol_handler_packages:
    serial.protocol_handler_packages.append("khep_twin.ports")
