"""Scale: many robots' lives, compiled and on all cores."""
