"""Logs and rollouts as datasets for offline learning."""
