"""Tests of the errors' fields: programs read them instead of the text."""

import pickle
from pathlib import Path

import pytest

from khep_twin import Network, World, playpen, read_log
from khep_twin.errors import (
    KhepTwinError,
    LogError,
    MissingExtraError,
    MissingNumbaError,
    PlaypenError,
    PortError,
    Problem,
    StudyError,
)
from khep_twin.log.decoding import DecodeError
from khep_twin.playpen import Playpen, bitmap_files
from khep_twin.ports.twin import TwinOptions
from khep_twin.sensing.calibration import read
from khep_twin.sweep.study import load

ARENA = """
version = 1
name = "arena"
[arena]
width_mm = 600
height_mm = 500
[[block]]
x_mm = 100
y_mm = 100
length_mm = 50
width_mm = 50
heigth_mm = 50
"""


def refused(text: str) -> PlaypenError:
    with pytest.raises(PlaypenError) as caught:
        playpen.parse(text, "arena.toml")
    return caught.value


def test_a_wrong_key_of_a_playpen_has_its_place_and_the_valid_keys() -> None:
    missing, unknown = refused(ARENA).problems
    assert (missing.file, missing.line, missing.key, missing.value) == ("arena.toml", 7, "height_mm", None)
    assert (unknown.line, unknown.key, unknown.value) == (12, "heigth_mm", 50)
    assert unknown.location == ("block", 0, "heigth_mm")
    assert "height_mm" in unknown.expected
    assert str(unknown).startswith(
        "arena.toml:12: block 1: heigth_mm = 50: unknown key; did you mean 'height_mm'?"
    )


def test_a_wrong_value_of_a_playpen_has_the_value_and_what_was_expected() -> None:
    error = refused(ARENA.replace("heigth_mm = 50", 'height_mm = "high"'))
    assert (error.file, error.line, error.key, error.value) == ("arena.toml", 12, "height_mm", "high")
    assert str(error) == f'arena.toml:12: block 1: height_mm = "high"; expected {error.expected}'


def test_a_problem_of_the_whole_playpen_has_fields_too() -> None:
    text = (
        ARENA.replace("heigth_mm", "height_mm")
        + 'surface = "felty"\n[[lamp]]\nx_mm = 700\ny_mm = 9\nz_mm = 50\npower_w = 1\n'
    )
    surface, lamp = refused(text).problems
    assert (surface.line, surface.key, surface.value) == (13, "surface", "felty")
    assert isinstance(surface.expected, tuple)
    assert (lamp.line, lamp.key, lamp.value, lamp.expected) == (15, "x_mm", 700, "0 to 600")
    assert lamp.text == "lamp 1: x_mm = 700: outside the arena; expected 0 to 600"


@pytest.mark.parametrize("name", ["x" * 5000, f"{'x/' * 200}y", "a\nb", "a\0b", "a\x1b[31mb", "\ud800"])
def test_a_name_that_no_file_has_is_refused_in_one_line_of_printable_characters(name: str) -> None:
    for loader in (Playpen.load, read, load, read_log, Network.load, bitmap_files.read, World):
        with pytest.raises(KhepTwinError) as caught:
            loader(name)  # type: ignore[operator]
        message = str(caught.value)
        assert message.isprintable()
        assert len(message) < 700
        assert caught.value.file == name


def test_a_file_that_is_missing_is_a_field() -> None:
    for error, loader in ((PlaypenError, Playpen.load), (KhepTwinError, read), (StudyError, load)):
        with pytest.raises(error) as caught:
            loader(Path("nowhere.toml"))
        assert (caught.value.file, caught.value.line, caught.value.key) == ("nowhere.toml", None, None)
        assert str(caught.value).startswith("nowhere.toml: no such file; expected the path of a ")


def test_an_argument_has_its_name_and_value() -> None:
    with pytest.raises(PortError, match=r"^seed = -1; expected an integer from 0 to 2\*\*63-1$") as caught:
        TwinOptions(seed=-1)
    error = caught.value
    assert (error.key, error.value, error.expected) == ("seed", -1, "an integer from 0 to 2**63-1")
    with pytest.raises(
        PortError, match=r"^rom = '5.0': unknown; did you mean '5.02'\? \(choices: "
    ) as caught:
        TwinOptions(rom="5.0")
    assert caught.value.key == "rom"
    assert "5.02" in (caught.value.expected or ())


def test_a_misfit_of_a_log_has_its_file_and_channel() -> None:
    error = DecodeError("length 3", "8 values").to_log_error(Path("run.mcap"), "/proximity", 20_000_000)
    assert isinstance(error, LogError)
    assert str(error) == "run.mcap: /proximity at 0.0200 s: length 3; expected 8 values"
    assert (error.file, error.key) == ("run.mcap", "/proximity")
    assert (error.value, error.expected) == ("length 3", "8 values")


def test_an_error_without_fields_is_its_message() -> None:
    error = PlaypenError("no room", ", as with --seed")
    assert (str(error), error.plain, error.problems) == ("no room, as with --seed", "no room", ())
    assert [error.file, error.line, error.key, error.value, error.expected] == [None] * 5


def test_fields_pass_from_process_to_process() -> None:
    error = pickle.loads(pickle.dumps(refused(ARENA)))
    assert str(error) == str(refused(ARENA))
    assert error.problems == refused(ARENA).problems
    assert Problem((), "text", file="a.toml").key is None


@pytest.mark.parametrize("error", [MissingExtraError("dask", "cluster"), MissingNumbaError(is_off=True)])
def test_an_error_about_what_is_missing_comes_back_from_a_worker(error: KhepTwinError) -> None:
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
