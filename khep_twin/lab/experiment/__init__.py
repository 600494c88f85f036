"""Controllers and series of runs, their measures, and runs repeated from logs."""
