"""What the page gets besides drafts: maps of the library, logs of its twins, and reports on them."""

import io
import time
from pathlib import Path

from PIL import Image

from khep_twin import playpen
from khep_twin.log.recorded import read_recorded
from tests.web.conftest import Asker
from tests.web.test_guard import DRAFT


def test_each_playpen_of_the_library_has_a_line_and_a_small_map(asker: Asker) -> None:
    library = asker.do("hello")[1]["library"]
    assert list(library) == playpen.names()
    assert library["obstacles"] == "A course for a Braitenberg vehicle, with a lamp"
    status, drawn = asker.do("thumbnail", name="obstacles")
    assert status == 200
    with Image.open(io.BytesIO(drawn)) as picture:
        assert max(picture.size) in range(190, 211)
        assert picture.size[0] > picture.size[1]  # as the arena
    assert asker.do("thumbnail", name="obstacles")[1] == drawn
    assert asker.do("thumbnail", name="nowhere")[0] == 400


def test_a_log_and_its_report_are_there_after_the_run(asker: Asker, tmp_path: Path) -> None:
    status, started = asker.do("start", draft=DRAFT, log="run.mcap", speed=0)
    assert status == 200
    assert started["log"] == "run.mcap"
    assert started["view"].endswith("run.mcap")
    assert " view " in started["view"]
    while asker.do("scene")[0] != 200:
        time.sleep(0.05)
    asker.do("end")
    status, log = asker.do("log", file="run.mcap")
    assert (status, log) == (200, (tmp_path / "run.mcap").read_bytes())
    assert read_recorded(tmp_path / "run.mcap")
    status, report = asker.do("report", file="run.mcap")
    assert status == 200
    assert b"<html" in report[:200]
    for action in ("log", "report"):
        assert asker.do(action, file="none.mcap")[0] == 400
        assert asker.do(action, file="../run.mcap")[0] == 403
        assert asker.do(action, file="mine.toml")[0] == 400


def test_a_twin_that_is_started_anew_does_not_replace_the_log_of_the_one_before(
    asker: Asker, tmp_path: Path
) -> None:
    assert asker.do("start", draft=DRAFT, log="run.mcap", seed=1, speed=0)[0] == 200
    while asker.do("scene")[0] != 200:
        time.sleep(0.05)
    again, told = asker.do("start", draft=DRAFT, log="run.mcap", seed=2, speed=0)
    while again == 200 and asker.do("scene")[0] != 200:
        time.sleep(0.05)
    asker.do("end")
    assert read_recorded(tmp_path / "run.mcap").label.metadata["seed"] == "1"
    assert (again, told["error"][:10]) == (400, "run.mcap: ")
