"""Logs in rerun: recordings, stills, and runs that go on."""
