"""Calibrations fitted to measurements of one robot."""
