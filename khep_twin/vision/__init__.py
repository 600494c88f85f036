"""The K213 in a world: its body, and its images by plain and compiled code."""
