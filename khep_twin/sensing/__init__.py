"""Models of the sensors: surfaces, optics of proximity, ambient light, calibrations."""
