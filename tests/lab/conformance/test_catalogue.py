"""The catalogues of conformance checks: each check that is written is in one, once."""

import importlib
import pkgutil
from types import ModuleType

import pytest

from khep_twin.lab.conformance import port, recording
from khep_twin.lab.conformance.port import catalogue as port_catalogue
from khep_twin.lab.conformance.port.check import Check
from khep_twin.lab.conformance.recording import catalogue as recording_catalogue
from khep_twin.lab.conformance.recording.check import RecordingCheck


def collect_names(package: ModuleType, kind: type) -> list[str]:
    modules = [
        importlib.import_module(f"{package.__name__}.{info.name}")
        for info in pkgutil.iter_modules(package.__path__)
    ]
    return [value.name for module in modules for value in vars(module).values() if isinstance(value, kind)]


@pytest.mark.parametrize(
    ("package", "kind", "catalogue"),
    [(port, Check, port_catalogue.CHECKS), (recording, RecordingCheck, recording_catalogue.CHECKS)],
    ids=["port", "recording"],
)
def test_each_check_that_is_written_is_listed_once(
    package: ModuleType, kind: type, catalogue: tuple[Check | RecordingCheck, ...]
) -> None:
    assert sorted(check.name for check in catalogue) == sorted(collect_names(package, kind))
    assert len({check.name for check in catalogue}) == len(catalogue)


def test_checks_that_move_the_robot_come_after_those_that_leave_it_but_for_a_turrets_own() -> None:
    base = [bool(check.moves) for check in port_catalogue.CHECKS if check.turret is None]
    assert base == sorted(base)
