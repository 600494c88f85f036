"""Challenges: tasks for controller files, with a score that repeats, and tables of a class's results."""
