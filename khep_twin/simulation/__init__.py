"""State of a simulation, and its compiled code."""
