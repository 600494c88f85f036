"""Studies over many rollouts, in processes that may die."""
