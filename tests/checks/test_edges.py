"""A share of the check edges: playpens that pass the check do not break under a robot at full speed."""

import pytest

from checks.edges import find_fault, playpens, text_of
from khep_twin import playpen
from khep_twin.errors import PlaypenError

SHARE = 4


def test_a_share_of_the_search_finds_nothing() -> None:
    problems = {number: find_fault(number, playpen, seconds=3.0) for number, playpen in playpens(0, SHARE)}
    assert problems == dict.fromkeys(problems)


def test_a_number_is_always_the_same_playpen_and_some_pass_the_check() -> None:
    texts = [text_of(number) for number in range(50)]
    assert texts == [text_of(number) for number in range(50)]
    assert len(set(texts)) == len(texts)
    assert 5 < sum(map(_passes, texts)) < 45


def test_an_arena_that_a_robot_would_drive_over_is_seen_by_the_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("khep_twin.playpen.checks.LOWEST_WALL_MM", 0.0)
    low = playpen.parse(
        'version = 1\nname = "low"\n[arena]\nwidth_mm = 250\nheight_mm = 200\nwall_height_mm = 3\n'
        "[[robot]]\nx_mm = 100\ny_mm = 100\nheading_deg = 0\n",
        "low",
    )
    assert "khepera0/base is outside the arena" in (find_fault(0, low) or "")


def _passes(text: str) -> bool:
    try:
        playpen.parse(text, "edge.toml")
    except PlaypenError:
        return False
    return True
