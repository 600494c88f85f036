"""Checks of a Khepera IV on which kh4server runs, at a port."""
