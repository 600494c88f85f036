"""What the tests of sensors are measured against."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def reference() -> Path:
    """Folder of the tables that were measured on real robots, which the project does not ship."""
    folder = os.environ.get("KHEP_TWIN_REFERENCE_DATA")
    if not folder:
        pytest.skip("KHEP_TWIN_REFERENCE_DATA names no folder with the measured tables")
    return Path(folder)
