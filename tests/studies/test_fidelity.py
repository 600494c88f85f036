"""The page of fidelity: its rows are all comparisons, and each part measures its quantity."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from khep_twin.board.kernel import PROXIMITY
from khep_twin.world import World
from studies import fidelity, fidelity_light, fidelity_manual, fidelity_motion
from studies.fidelity_comparison import Comparison, Outcome, noise_variance, read_at_rest, short
from studies.one_object import WALL, scene

QUICK = (fidelity_manual.figure_13, fidelity_manual.khepera2_facing, fidelity_light.figure_9)
TABLES = os.environ.get("KHEP_TWIN_REFERENCE_DATA")
ROOT = Path(__file__).parents[2]


def comparisons() -> Iterator[Comparison]:
    for comparisons_of_section in fidelity.SECTIONS.values():
        yield from comparisons_of_section


def outcomes() -> dict[str, Outcome]:
    """Made-up outcomes: with and without a floor, peers and a note."""
    outcomes = [Outcome(3.14159), Outcome(0.012, 0.5, {"Webots": 12.34, "Enki": 1.0}, "a note")]
    return {comparison.name: outcomes[number % 2] for number, comparison in enumerate(comparisons())}


def test_the_page_has_the_comparisons_that_there_are_in_their_order() -> None:
    names = {
        section: [comparison.name for comparison in section_comparisons]
        for section, section_comparisons in fidelity.SECTIONS.items()
    }
    assert fidelity.names(fidelity.PAGE.read_text()) == names
    assert fidelity.names(fidelity.text(outcomes())) == names


def test_no_two_comparisons_have_one_name_and_none_breaks_the_table() -> None:
    names = [comparison.name for comparison in comparisons()]
    assert len(set(names)) == len(names)
    for candidate in comparisons():
        assert not {"|", "\n"} & set(candidate.name + candidate.source + candidate.basis + candidate.unit)


def test_a_row_has_source_basis_figure_floor_peers_and_note() -> None:
    (_, second, *_), page = list(comparisons()), fidelity.text(outcomes())
    cells = (
        second.name,
        second.source,
        second.basis,
        f"0.012 {second.unit}",
        "0.5",
        "Webots 12, Enki 1",
        "a note",
    )
    assert f"| {' | '.join(cells)} |" in page.splitlines()


@pytest.mark.parametrize(
    ("value", "expected"), [(0.0123, "0.012"), (9.94, "9.9"), (9.96, "10"), (1234.5, "1234")]
)
def test_numbers_have_two_digits(value: float, expected: str) -> None:
    assert short(value) == expected


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    fidelity.draw(outcomes(), tmp_path / "fidelity.png")
    assert (tmp_path / "fidelity.png").read_bytes().startswith(b"\x89PNG")


def test_without_the_tables_the_command_refuses_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KHEP_TWIN_REFERENCE_DATA", raising=False)
    monkeypatch.setattr(sys, "argv", ["fidelity"])
    with pytest.raises(
        SystemExit, match="KHEP_TWIN_REFERENCE_DATA is not set; expected the folder"
    ) as refusal:
        fidelity.main()
    assert "\n" not in str(refusal.value)


def test_readme_and_the_page_of_the_senses_link_to_the_page() -> None:
    assert "(docs/fidelity.md)" in (ROOT / "README.md").read_text()
    assert "(fidelity.md)" in (ROOT / "docs" / "senses.md").read_text()
    assert fidelity.PICTURE.exists()


@pytest.mark.parametrize("order", [2, 4])
def test_differences_tell_the_noise_and_not_the_curve(order: int) -> None:
    at = np.linspace(0, 6, 4000)
    noise = 7 * np.random.default_rng(0).standard_normal((2, 4000))
    assert noise_variance(300 * np.sin(at), order) == pytest.approx(0, abs=1e-3)
    np.testing.assert_allclose(np.sqrt(noise_variance(300 * np.sin(at) + noise, order)), 7, rtol=0.06)


def test_a_robot_at_rest_reads_what_a_world_does() -> None:
    starts = [(2955.0, 1500.0, 20.0), (2960.0, 1400.0, -110.0)]
    counts, ambient = read_at_rest(scene(WALL), np.array(starts))
    for start, expected in zip(starts, counts, strict=True):
        robot = scene(WALL).robots[0]
        x_mm, y_mm, heading_deg = start
        moved = robot.model_copy(update={"x_mm": x_mm, "y_mm": y_mm, "heading_deg": heading_deg})
        world = World(scene(WALL).model_copy(update={"robots": (moved,)}), noise=False)
        assert world.robots[0].registers[PROXIMITY].tolist() == expected.tolist()
    assert counts.max() > 500
    assert ambient.min() > 450


def test_a_sensor_faces_a_wall_at_the_distance_of_its_face() -> None:
    # Side and front look the same from their own faces, but for their own optics.
    for sensor in (0, 2):
        counts = fidelity_manual.face_to_face("khepera1-manual", sensor, np.array([0.0, 15.0, 35.0, 70.0]))
        assert counts[1] > counts[2] > counts[3]
    # The front sensor's face is 2 mm inside the shell.
    assert np.isnan(counts).tolist() == [True, False, False, False]


def test_the_twin_moves_as_its_pulses_say() -> None:
    way, turn = fidelity_motion.constant_speed_motion(5, 5)
    assert (way, turn) == (pytest.approx(0.04, rel=0.01), pytest.approx(0, abs=0.02))
    assert fidelity_motion.constant_speed_motion(-3, 3)[1] == pytest.approx(0.048 / 0.052, rel=0.02)


@pytest.mark.skipif(not TABLES, reason="KHEP_TWIN_REFERENCE_DATA names no folder with the measured tables")
@pytest.mark.parametrize("measure", QUICK, ids=lambda measure: measure.__name__)
def test_the_page_has_the_figures_that_the_tables_give(measure) -> None:  # type: ignore[no-untyped-def]
    (compared,) = (comparison for comparison in comparisons() if comparison.measure is measure)
    (line,) = (
        row for row in fidelity.PAGE.read_text().splitlines() if row.startswith(f"| {compared.name} |")
    )
    assert f"| {short(measure(Path(str(TABLES))).figure)} {compared.unit} |" in line
