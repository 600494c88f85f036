"""How fast the twin is, as ratios to floors measured in the same run."""
