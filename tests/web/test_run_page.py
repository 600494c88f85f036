"""Pages that play runs: what they contain, and which logs they refuse."""

import re
from base64 import b64decode, b64encode
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

import pytest
from command_line import khep_twin as run_command
from log_rewriting import rewritten
from relay_logs import in_turn, relayed

import khep_twin
from khep_twin.errors import LogError
from khep_twin.web import run_content
from khep_twin.web.run_page import ASSETS, RunPage
from tests.web.run_pages import HOSTILE, headers, record, with_hostile_texts


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a robot that drives into a block."""
    return record(tmp_path_factory.mktemp("page") / "run.mcap", 4.0, commands=(b"N\n", b"O\n", b"H\n"))


def scripts(html: str) -> Sequence[str]:
    return re.findall(r"<script>(.*?)</script>", html, re.DOTALL)


def test_a_page_has_one_script_allowed_by_its_hash_and_nothing_from_elsewhere(log: Path) -> None:
    html = RunPage([log]).html
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', html)
    (script,) = scripts(html)
    (style,) = re.findall(r"<style>(.*?)</style>", html, re.DOTALL)
    for kind, text in (("script", script), ("style", style)):
        digest = b64encode(sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}';" in policy
    assert policy.startswith("default-src 'none'; ")
    assert not re.findall(r"""(?:src|href)=["'](?!#)|@import|url\(""", html.replace(script, ""))
    assert not re.findall(r"^(?:import|export)\b", script, re.MULTILINE)
    assert len(html) < 1_200_000


def test_the_script_has_every_module_that_the_player_imports_once(log: Path) -> None:
    (script,) = scripts(RunPage([log]).html)
    names = re.findall(r'^modules\["([\w.]+)"\] = ', script, re.MULTILINE)
    assert {"three.min.js", "drawing.js", "three_d.js", "panel.js", "curves.js", "shades.js"} <= {*names}
    assert names[-1] == "player.js"
    assert len(names) == len({*names})
    imports = {
        name for path in names for name in re.findall(r'from "\./([\w.]+)"', (ASSETS / path).read_text())
    }
    assert imports == {*names} - {"player.js"}


def test_a_page_has_the_runs_origin_robots_contacts_and_texts(log: Path) -> None:
    (run,) = headers(RunPage([log]).html)
    assert run["origin"]["playpen"] == "obstacles"
    assert run["origin"]["seed"] == "3"
    assert run["origin"]["repeat it"] == "khep-twin repeat run.mcap"
    assert [robot["name"] for robot in run["robots"]] == ["khepera0"]
    assert run["scene"]["bodies"][0] == "khepera0/base"
    assert not any("wheel" in name for name in run["scene"]["bodies"])
    assert run["contacts"]
    assert all(robot == "khepera0" and start <= end for robot, start, end in run["contacts"])
    assert run["texts"]["khepera0"][:3] == ["D,20,20", "d", "N"]
    assert (run["interval"], run["lineInterval"]) == (0, 0)


def test_texts_of_a_log_are_no_markup(log: Path, tmp_path: Path) -> None:
    hostile = with_hostile_texts(log, tmp_path / "<img src=x onerror=alert(3)>.mcap")
    html = RunPage([hostile], with_log=True).html
    (run,) = headers(html)
    assert run["origin"]["controller"] == HOSTILE
    assert HOSTILE in run["texts"]["khepera0"]
    assert "onerror=alert" not in html.replace("&lt;img src=x onerror=alert(3)&gt;", "")
    assert len(scripts(html)) == 1


def test_a_long_log_is_thinned_but_not_at_events_and_contacts(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_content, "_MAX_SAMPLES", 10)
    monkeypatch.setattr(run_content, "_MAX_LINES", 4)
    (run,) = headers(RunPage([log]).html)
    assert run["interval"] == pytest.approx(0.4)
    counts = {item["name"]: item["n"] for item in run["series"]}
    assert 10 < counts["bodies"] < 20
    assert len(run["texts"]["khepera0"]) == counts["/khepera0/serial"] <= 6


def test_a_real_robots_log_has_curves_and_its_transcript(tmp_path: Path) -> None:
    lines = in_turn(b"N\n", b"n,0,0,500,0,0,0,0,0\r\n", b"H\n", b"h,10,12\r\n")
    (run,) = headers(RunPage([relayed(tmp_path / "real.mcap", lines)]).html)
    assert run["scene"] is None
    assert run["draft"] is None
    assert "repeat it" not in run["origin"]
    assert run["texts"]["khepera0"] == ["N", "n,0,0,500,0,0,0,0,0", "H", "h,10,12"]


def test_a_log_with_nothing_to_show_or_without_its_playpen_is_refused_in_one_line(
    log: Path, tmp_path: Path
) -> None:
    with pytest.raises(LogError, match="no poses, readings or lines; expected a log with one of them"):
        RunPage([relayed(tmp_path / "empty.mcap")])
    bare = rewritten(log, tmp_path / "bare.mcap", attachment=lambda name, data: None)
    with pytest.raises(LogError, match=r"playpen.toml: missing; expected it among the attachments"):
        RunPage([bare])
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(log.read_bytes()[:-100])
    with pytest.raises(LogError, match="recover"):
        RunPage([torn])


def test_the_command_writes_logs_side_by_side_with_the_logs_in_it(log: Path, tmp_path: Path) -> None:
    page = tmp_path / "pair.html"
    result = run_command("view", str(log), str(log), "--html", str(page), "--with-log")
    assert (result.returncode, result.stderr) == (0, "")
    html = page.read_text()
    assert [run["name"] for run in headers(html)] == [f"{log.parent.name}/run {number}" for number in (1, 2)]
    kept = re.findall(r'class="log" data-name="run.mcap">([^<]*)<', html)
    assert [b64decode(text) for text in kept] == [log.read_bytes()] * 2


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("view", "run.mcap", "--html", "run.txt"), "--html run.txt: expected a name that ends in .html"),
        (("view", "run.mcap", "--with-log"), "expected --html FILE.html with it"),
        (("view", *["run.mcap"] * 9, "--html", "run.html"), "9 logs; expected at most 8, side by side"),
        (("view", "run.mcap", "--html", "run.html", "--web"), "cannot be combined"),
        (("run", "--html", "run.html"), "expected --log FILE.mcap with it"),
    ],
)
def test_impossible_options_are_refused(words: Sequence[str], reason: str) -> None:
    result = run_command(*words)
    assert result.returncode == 2
    assert reason in result.stderr


def test_a_notebook_shows_the_page_in_a_frame_of_its_own(log: Path) -> None:
    page = khep_twin.read_log(log).html()
    frame = page._repr_html_()
    assert frame.startswith('<iframe sandbox="allow-scripts allow-downloads"')
    assert "<script>" not in frame


def test_a_run_writes_its_page_and_replaces_none_without_being_told(tmp_path: Path) -> None:
    words = ("run", "braitenberg", "--playpen", "obstacles", "--seconds", "0.2", "--log", "a.mcap")
    result = run_command(*words, "--html", "a.html", folder=tmp_path)
    assert result.returncode == 0
    assert "page     a.html: 0.9 MB, opens in any browser" in result.stdout
    (run,) = headers((tmp_path / "a.html").read_text())
    assert run["origin"]["controller"] == "braitenberg"
    assert run["sources"]
    (tmp_path / "a.mcap").unlink()
    again = run_command(*words, "--html", "a.html", folder=tmp_path)
    assert again.returncode == 2
    assert "a.html: is there already; expected another name, or --force to replace it" in again.stderr
