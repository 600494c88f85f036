"""The robot's electronics without input or output: protocol, kernel, ROMs, serial controller, turrets."""
