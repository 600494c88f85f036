"""Maps of the library, logs of twins, and reports on them, as the page gets them."""

import io
import time
from pathlib import Path

from PIL import Image

from khep_twin import playpen
from khep_twin.log.recorded import read_recorded_run
from tests.web.conftest import Client
from tests.web.test_guard import DRAFT


def test_each_playpen_of_the_library_has_a_line_and_a_small_map(client: Client) -> None:
    library = client.do("hello")[1]["library"]
    assert list(library) == playpen.names()
    assert library["obstacles"] == "A course for a Braitenberg vehicle, with a lamp"
    status, drawn = client.do("thumbnail", name="obstacles")
    assert status == 200
    with Image.open(io.BytesIO(drawn)) as picture:
        assert max(picture.size) in range(190, 211)
        assert picture.size[0] > picture.size[1]  # as the arena
    assert client.do("thumbnail", name="obstacles")[1] == drawn
    assert client.do("thumbnail", name="nowhere")[0] == 400


def test_a_log_its_report_and_its_page_are_there_after_the_run(client: Client, tmp_path: Path) -> None:
    status, started = client.do("start", draft=DRAFT, log="run.mcap", speed=0)
    assert status == 200
    assert started["log"] == "run.mcap"
    assert started["view"].endswith("run.mcap")
    assert " view " in started["view"]
    while client.do("scene")[0] != 200:
        time.sleep(0.05)
    client.do("end")
    status, log = client.do("log", file="run.mcap")
    assert (status, log) == (200, (tmp_path / "run.mcap").read_bytes())
    assert read_recorded_run(tmp_path / "run.mcap")
    status, report = client.do("report", file="run.mcap")
    assert status == 200
    assert b"<html" in report[:200]
    status, page = client.do("page", file="run.mcap")
    assert status == 200
    assert b"<html" in page[:200]
    for action in ("log", "report", "page"):
        assert client.do(action, file="none.mcap")[0] == 400
        assert client.do(action, file="../run.mcap")[0] == 403
        assert client.do(action, file="mine.toml")[0] == 400


def test_a_twin_that_is_started_anew_does_not_replace_the_log_of_the_one_before(
    client: Client, tmp_path: Path
) -> None:
    assert client.do("start", draft=DRAFT, log="run.mcap", seed=1, speed=0)[0] == 200
    while client.do("scene")[0] != 200:
        time.sleep(0.05)
    again, reply = client.do("start", draft=DRAFT, log="run.mcap", seed=2, speed=0)
    while again == 200 and client.do("scene")[0] != 200:
        time.sleep(0.05)
    client.do("end")
    assert read_recorded_run(tmp_path / "run.mcap").label.metadata["seed"] == "1"
    assert (again, reply["error"][:10]) == (400, "run.mcap: ")
