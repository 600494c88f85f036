"""Episodes in a plane instead of MuJoCo, for screening."""
