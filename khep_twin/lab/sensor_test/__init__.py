"""Sensor tests: readings while a robot turns or drives."""
