"""A night of all long checks, in parts that accumulate, and the page of their findings."""
