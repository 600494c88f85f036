"""The locks: complete for every version of Python, since pip resolves nothing when it installs them."""

import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tools import wheels

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize("version", wheels.VERSIONS)
def test_a_lock_has_what_the_package_and_its_extras_require(version: str) -> None:
    packages = wheels.locked(version)
    lines = sum(PROJECT["optional-dependencies"].values(), PROJECT["dependencies"])
    for requirement in map(Requirement, lines):
        pin, hashes = packages[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(pin), requirement
        assert hashes


@pytest.mark.parametrize("version", wheels.VERSIONS)
def test_labmaze_is_locked_only_where_it_has_a_wheel(version: str) -> None:
    assert ("labmaze" in wheels.locked(version)) is (version in {"3.11", "3.12"})


def test_the_package_is_for_the_versions_that_are_locked() -> None:
    word = "Programming Language :: Python :: "
    named = [line.removeprefix(word) for line in PROJECT["classifiers"] if line.startswith(word)]
    assert named == wheels.VERSIONS
    assert PROJECT["requires-python"] == ">=3.11,<3.15"
