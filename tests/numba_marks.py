"""Marks of tests that need numba, and the kinds of code that others run: plain and compiled."""

import importlib.util

import pytest

with_numba = pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="numba is not installed")

KINDS = [pytest.param(False, id="plain"), pytest.param(True, id="compiled", marks=with_numba)]
"""Values of a parameter `compiled`."""
