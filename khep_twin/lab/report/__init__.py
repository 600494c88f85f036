"""Reports and tables of logs and series."""
