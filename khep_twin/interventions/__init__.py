"""Robots moved and lamps switched by hand in a running world."""
