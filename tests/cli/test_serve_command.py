"""`serve --from`: which run is resumed, and with which seed."""

import sys
from collections.abc import Callable

import pytest
from command_line import good

import khep_twin.cli.app  # noqa: F401
from khep_twin.log.recorded import BranchPoint
from khep_twin.ports import branching

SERVE = sys.modules["khep_twin.cli.serve"]


@pytest.mark.parametrize(("words", "seed"), [([], None), (["--seed", "7"], 7), (["--seed", "0"], 0)])
def test_a_resumed_run_keeps_its_seed_unless_one_is_given(
    words: list[str], seed: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int | None] = []

    def note_seed(path: object, change: BranchPoint, *_: object, **__: object) -> None:
        seeds.append(change.seed)

    def open_only(open_twin: Callable[[], object], *_: object) -> None:
        open_twin()

    monkeypatch.setattr(branching, "open_log", note_seed)
    monkeypatch.setattr(SERVE, "_serve_twin", open_only)
    assert good("serve", "--from", "run.mcap@1.5", *words) == ""
    assert seeds == [seed]
