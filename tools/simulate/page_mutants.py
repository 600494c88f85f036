"""Broken builds of the page."""

MUTANTS = {}
