"""Environments for learning: dm_env, Gymnasium, PettingZoo."""
