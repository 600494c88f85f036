"""Checks of the protocol on any port."""
