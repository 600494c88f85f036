"""Files of users: atomic writing, TOML that keeps its comments, MAT files."""
