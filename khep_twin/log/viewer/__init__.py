"""Logs in rerun: recordings, stills, and running simulations."""
