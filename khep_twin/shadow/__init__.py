"""A robot followed by its line: where it is, and what is wrong with it."""
