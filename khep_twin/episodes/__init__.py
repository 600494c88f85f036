"""Episodes without a serial line, compiled and on all cores."""
