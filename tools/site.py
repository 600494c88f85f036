"""Source of the site from the repository's pages, for mkdocs: `make docs`.

    python -m tools site [FOLDER]

The front page has the head of the README and links by task. The gallery has every picture of the pages. The
reference is that of `python -m tools reference`. Links between pages stay as they are; those to the README
lead to its page. Runs are played by pages of their own.
"""

import re
import shutil
from pathlib import Path

from tools.command_table import command_line
from tools.reference import write as write_reference
from tools.runs import PAGES as RUN_PAGES
from tools.runs import RUNS
from tools.runs import write as write_runs

ROOT = Path(__file__).parents[1]

PAGES = {
    "README.md": "about.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "mjcf/README.md": "mjcf/playpens.md",
    "checks/README.md": "checks/checks.md",
}
"""Pages with other names in the site, where a README is the index of its section."""

FOLDERS = {
    "docs": ("md", "png", "json", "svg"),
    "mjcf": ("md", "png", "xml"),
    "examples": ("py", "toml"),
    "notebooks": ("ipynb",),
}
"""Folders, and the kinds of files that pages link to."""

STYLE = """
/* Words of a table stay whole, and its columns wide enough to be read; a wide one scrolls. */
.md-typeset :is(td, th) code { word-break: normal; overflow-wrap: normal; }
.md-typeset table:not([class]) :is(td, th) { min-width: 5rem; padding: .5em .8em; }
.md-typeset table:not([class]) :is(td, th):last-child { min-width: 9rem; }
.md-typeset .whole { white-space: nowrap; }
/* A line of code has a hundred characters. */
.md-typeset pre > code { font-size: .74em; }
@media screen and (min-width: 76.25em) { .md-grid { max-width: 66rem; } .md-sidebar { width: 10.6rem; } }
.md-typeset .md-button { margin: .2rem 0; }
.md-typeset h1 .headerlink, .md-typeset h2 .headerlink { margin-left: .2rem; }
"""

TASKS = {
    "I have a robot": """Change the name of the port, and [your program](docs/host.md) drives the robot or its
    twin. [Calibrate](docs/senses.md#calibrating-your-robot) the twin to your robot, let it run
    [beside the robot](docs/twin.md), and [log](docs/logs.md) the line.""",
    "I have none": """The [tutorial](docs/tutorial.md) needs no robot: drive one on your screen,
    [draw its world](docs/designer.md) in the browser, look at [runs in rerun](docs/logs.md#viewing), and
    repeat [classic experiments](docs/classics.md).""",
    "I teach": """Eight [lessons](docs/lessons/README.md) with a check each, [challenges](docs/challenges.md)
    that score the programs of a class, [notebooks](docs/notebooks.md), [reports](docs/report.md) of runs, and
    the [Khepera Toolbox](docs/toolbox.md) in Python.""",
    "I evolve or train": """[From a genome or a policy to the robot](docs/evolve_train_drive.md);
    [many episodes at once](docs/scale.md), in MuJoCo or in a plane;
    [environments](docs/environments.md) for Gymnasium, PettingZoo and dm_control;
    [studies](docs/sweep.md) on [clusters](docs/cluster.md); [datasets](docs/datasets.md).""",
    "I test host code": """[Serve a twin](docs/serving.md) on a terminal or a network port, with faults, in
    [real or simulated time](docs/time.md), and check a robot, an emulator or a recording
    [against the protocol](docs/protocol.md#checking-a-robot-an-emulator-or-a-recording).""",
}
"""Links into the pages, by the reader's task."""

PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)]+\.(?:png|svg))\)")

README_PICTURE = re.compile(r"!\[[^\]]*\]\(docs/pictures/run\.png\)")


def main() -> None:
    """Write the source into the folder of the command line."""
    parser = command_line(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default="out/site-source")
    write(parser.parse_args().folder)


def write(target: Path) -> None:
    """Write the source into a folder, which is emptied first."""
    shutil.rmtree(target, ignore_errors=True)
    for folder, kinds in FOLDERS.items():
        for path in sorted(ROOT.glob(f"{folder}/**/*")):
            name = str(path.relative_to(ROOT))
            if path.suffix[1:] in kinds and "reference" not in path.parts and name not in PAGES:
                _copy(path, target / name)
    for name, page in PAGES.items():
        _copy(ROOT / name, target / page)
    shutil.copy(ROOT / "khep_twin/assets/web/icon.svg", target / "docs/icon.svg")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (target / "index.md").write_text(_front(readme), encoding="utf-8")
    (target / "site.css").write_text(STYLE, encoding="utf-8")
    (target / "gallery.md").write_text(_gallery(target), encoding="utf-8")
    write_reference(target / "reference")
    write_runs(target / "runs")


def _copy(path: Path, to: Path) -> None:
    """Copy a file; in a page, let links to the pages at the top lead to their names in the site."""
    to.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix != ".md":
        shutil.copy(path, to)
        return
    text = path.read_text(encoding="utf-8")
    for name, page in PAGES.items():
        depth = len(path.relative_to(ROOT).parts) - 1
        text = re.sub(rf"\]\({'../' * depth}{name}", f"]({'../' * depth}{page}", text)
    text = README_PICTURE.sub(r"[\g<0>](runs/braitenberg.html)", text)
    if run := RUN_PAGES.get(str(path.relative_to(ROOT))):
        title, _, rest = text.partition("\n")
        text = f"{title}\n\n[Play a run](../runs/{run}.html): {RUNS[run][0]}.\n{rest}"
    to.write_text(text, encoding="utf-8")


def _front(readme: str) -> str:
    """Return the front page: one sentence, links by task, two commands, one picture."""
    title, sentence, picture = readme.split("\n\n")[:3]
    (commands, *_) = re.findall(r"```sh\n.*?```", readme, re.DOTALL)
    cards = "".join(f"-   **{task}**\n\n    {text}\n\n" for task, text in TASKS.items())
    return (
        f"---\ntitle: Khepera on MuJoCo\nhide: [navigation, toc]\n---\n{title}\n\n{sentence}\n\n"
        f'<div class="grid cards" markdown>\n\n{cards}</div>\n\n'
        f"{commands}\n\n[{picture}{{ width=560 }}](runs/braitenberg.html)\n\n"
        "[Tutorial](docs/tutorial.md){ .md-button .md-button--primary } "
        "[All that it does](about.md){ .md-button } [Gallery](gallery.md){ .md-button }\n"
    )


def _gallery(target: Path) -> str:
    """Return a page of every picture with its description, by the pages that they are on."""
    listed_pictures: set[Path] = set()
    parts = ["# Gallery\n\nAll pictures of the pages, each below a link to its page.\n"]
    for page in sorted(target.rglob("*.md")):
        text, location = page.read_text(encoding="utf-8"), page.relative_to(target)
        title = "Overview" if page.name == "about.md" else text.partition("\n")[0].removeprefix("# ")
        heading = f"## [{title}]({location})\n"
        for words, link in PICTURE.findall(text):
            picture = (page.parent / link).resolve()
            if (
                page.name not in ("index.md", "gallery.md")
                and picture not in listed_pictures
                and picture.exists()
            ):
                listed_pictures.add(picture)
                parts += [heading] * (heading not in parts)
                parts.append(f"![{words}]({picture.relative_to(target.resolve())})<br>{words}\n")
    return "\n".join(parts)
