"""Ports of a twin: khep:// in the host's own process, and a pseudo-terminal for every other program."""
