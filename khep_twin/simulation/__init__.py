"""Arrays of a simulation, and its compiled code."""
