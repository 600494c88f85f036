"""Checks of a recording."""
