"""User files: atomic writing, TOML editing that keeps comments, MAT files."""
