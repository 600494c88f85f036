"""three.js is shipped as one minified module (`python -m tools three-js`) without imports."""

import re
from hashlib import sha256
from http.client import HTTPConnection

from khep_twin.web.routes import ASSETS
from tests.web.conftest import Client
from tools.three_js import FILES, SUMS

MODULE = "three.min.js"


def test_the_shipped_files_are_those_of_the_build() -> None:
    lines = (ASSETS / SUMS).read_text().splitlines()
    sums = {name: digest for digest, name in (line.split("  ") for line in lines)}
    assert sums.keys() == FILES.keys() == {path.name for path in ASSETS.glob("three.*")} - {SUMS}
    for name, digest in sums.items():
        assert sha256((ASSETS / name).read_bytes()).hexdigest() == digest, name


def test_the_module_imports_nothing_and_exports_the_names_that_the_page_uses() -> None:
    code = (ASSETS / MODULE).read_text()
    assert not re.findall(r"""\bfrom\s*["'][^"']+["']|\bimport\(""", code)
    exports = set(re.findall(r"(?:\bas )?([\w$]+)[,}]", code[code.rindex("export{") :]))
    scripts = [path.read_text() for path in ASSETS.glob("*.js") if path.name != MODULE]
    uses = {name for script in scripts for name in re.findall(r"\bTHREE\.(\w+)", script)}
    for script in scripts:
        for imports in re.findall(rf'import {{([^}}]*)}} from "\./{re.escape(MODULE)}"', script):
            uses |= {name.strip() for name in imports.split(",")}
    assert len(uses) > 20
    assert uses <= exports


def test_it_is_served_under_the_pages_own_rules(client: Client) -> None:
    connection = HTTPConnection(client.host, timeout=10)
    connection.request("GET", f"{client.base}/static/{MODULE}", headers=client.headers())
    answer = connection.getresponse()
    assert (answer.status, answer.getheader("content-type")) == (200, "text/javascript; charset=utf-8")
    assert "default-src 'self'" in str(answer.getheader("content-security-policy"))
    connection.close()
