"""A finished run, or several side by side, as one HTML file that plays them, without a server or a network.

The file has the page's scripts, joined to one, and each log's content in packed form. Its content security
policy allows this script and this style by their hashes and nothing else. Texts of logs are in the packed
content alone, but for the title, which is escaped.
"""

import re
from base64 import b64encode
from collections.abc import Iterator, Sequence
from functools import cache
from hashlib import sha256
from html import escape
from pathlib import Path
from string import Template

from khep_twin import __version__
from khep_twin.errors import LogError
from khep_twin.files.atomic import part_file
from khep_twin.files.paths import StrPath
from khep_twin.log.decoding import read_errors
from khep_twin.log.mcap_recovery import Progress, partial_progress
from khep_twin.log.run_names import distinct_names
from khep_twin.web.run_content import RunContent

ASSETS = Path(__file__).parent.parent / "assets" / "web"

_IMPORT = re.compile(r'^import (\* as \w+|\{[^}]*\}) from "\./([\w.]+)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?:async )?(?:class|function|const) ([\w$]+)", re.MULTILINE)
_EXPORT_LIST = re.compile(r"\bexport\{([^}]*)\};")


class RunPage:
    """Page that plays logs side by side; below a cell of a notebook it is shown.

    Args:
        logs: Paths of finished logs, from left to right.
        with_log: True to keep the logs in the page, to be saved from there.
        progress: Function that takes the fraction read.

    Attributes:
        html: The page.

    Raises:
        LogError: A log cannot be read, or has nothing to show.
    """

    def __init__(self, logs: Sequence[StrPath], *, with_log: bool = False, progress: Progress = None) -> None:
        paths = [Path(log) for log in logs]
        names = distinct_names(paths)
        nodes: list[str] = []
        for index, (path, name) in enumerate(zip(paths, names, strict=True)):
            packed = RunContent(path, name, partial_progress(progress, index, len(paths))).pack()
            nodes.append(_data_node("packed", packed, path))
        if with_log:
            for path in paths:
                with read_errors(path):
                    nodes.append(_data_node("log", path.read_bytes(), path))
        script, style = _bundle(), _asset("designer.css") + _asset("player.css")
        policy = (
            f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(style)}'; "
            "base-uri 'none'; form-action 'none'"
        )
        self.html = Template(_asset("player.html")).substitute(
            policy=policy,
            version=__version__,
            title=escape(", ".join(names)),
            style=style,
            icons=_asset("icons.svg"),
            data="\n".join(nodes),
            script=script,
        )

    def save(self, path: StrPath, replace: bool = True) -> None:
        """Write the page to a file.

        Raises:
            LogError: The file cannot be written.
        """
        try:
            with part_file(Path(path), replace) as file:
                file.write(self.html.encode())
        except OSError as error:
            raise LogError(f"{path}: the page cannot be written: {error.strerror}") from error

    def _repr_html_(self) -> str:
        """Return a frame with the page, for notebooks."""
        sandbox = "allow-scripts allow-downloads"
        style = "width: 100%; height: 640px; border: 0"
        return f'<iframe sandbox="{sandbox}" style="{style}" srcdoc="{escape(self.html)}"></iframe>'


def _data_node(kind: str, data: bytes, path: Path) -> str:
    name = escape(path.name.encode("utf-8", "replace").decode())
    content = b64encode(data).decode("ascii")
    return f'<script type="application/octet-stream" class="{kind}" data-name="{name}">{content}</script>'


def _hash(text: str) -> str:
    """Return the hash of a script or style, as a content security policy has it."""
    return f"sha256-{b64encode(sha256(text.encode()).digest()).decode('ascii')}"


@cache
def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


@cache
def _bundle() -> str:
    """Return the player's modules as one script, each as a function after those that it imports."""
    modules = "\n".join(_functions("player.js", set()))
    script = f'"use strict";\nconst modules = {{}};\n{modules}\n'
    # These would end the element in the file, or start a comment there.
    return script.replace("</script", r"<\/script").replace("<!--", r"<\!--")


def _functions(name: str, included: set[str]) -> Iterator[str]:
    """Yield a module and those that it imports as functions that return their exports."""
    if name in included:
        return
    included.add(name)
    text = _asset(name)
    for _, imported in _IMPORT.findall(text):
        yield from _functions(imported, included)

    def declare(match: re.Match[str]) -> str:
        names = match[1].removeprefix("* as ").replace(" as ", ": ")
        return f'const {names} = modules["{match[2]}"];\n'

    exports = {exported: exported for exported in _EXPORT.findall(text)}
    for names in _EXPORT_LIST.findall(text):
        pairs = (item.split(" as ") for item in names.split(","))
        exports |= {pair[-1].strip(): pair[0].strip() for pair in pairs}
    body = re.sub(r"^export (?=\w)", "", _EXPORT_LIST.sub("", _IMPORT.sub(declare, text)), flags=re.MULTILINE)
    returned = ", ".join(f"{exported}: {local}" for exported, local in exports.items())
    yield f'modules["{name}"] = (() => {{\n{body}\nreturn {{ {returned} }};\n}})();'
