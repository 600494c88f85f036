"""Controllers, series of runs, their metrics, and runs repeated from logs."""
