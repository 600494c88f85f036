"""Commands whose effect on a twin depends on the state of a wheel's registers."""

SPEED, DUTY, TARGET, POSITION = 0, 1, 2, 3
