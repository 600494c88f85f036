"""The K213 in the world: its body, and its images plain and compiled."""
