"""three.js is shipped as its package has it (`python -m tools three-js`), and loads nothing else."""

import re
from hashlib import sha256
from http.client import HTTPConnection

from khep_twin.web.routes import ASSETS
from tests.web.conftest import Asker
from tools.three_js import FILES, SUMS


def test_the_shipped_files_are_those_of_the_package() -> None:
    lines = (ASSETS / SUMS).read_text().splitlines()
    sums = {name: digest for digest, name in (line.split("  ") for line in lines)}
    assert sums.keys() == FILES.keys() == {path.name for path in ASSETS.glob("three.*")} - {SUMS}
    for name, digest in sums.items():
        assert sha256((ASSETS / name).read_bytes()).hexdigest() == digest, name


def test_its_files_import_each_other_alone() -> None:
    for name in FILES:
        code = re.sub(r"/\*.*?\*/", "", (ASSETS / name).read_text(), flags=re.DOTALL)
        imported = re.findall(r"\bfrom '([^']+)';", code)
        assert imported or name in ("three.core.js", "three.LICENSE")
        assert {path.removeprefix("./") for path in imported} <= FILES.keys(), name


def test_it_is_served_under_the_pages_own_rules(asker: Asker) -> None:
    connection = HTTPConnection(asker.host, timeout=10)
    connection.request("GET", f"{asker.base}/static/three.module.js", headers=asker.own())
    answer = connection.getresponse()
    assert (answer.status, answer.getheader("content-type")) == (200, "text/javascript; charset=utf-8")
    assert "default-src 'self'" in str(answer.getheader("content-security-policy"))
    connection.close()
