"""Sensor tests: readings while a robot is turned or moved."""
