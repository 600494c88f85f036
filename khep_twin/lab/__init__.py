"""Experiments with a robot or a twin, on any port."""
