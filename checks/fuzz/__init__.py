"""Fuzz targets: arbitrary and damaged input for the board, files, logs, the designer's page and ports."""
