"""Models of the sensors: rays, optics of proximity, ambient light, calibrations."""
