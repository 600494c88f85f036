"""Checks of a robot or twin at a port."""
