"""The site's source out of the repository's pages, for mkdocs: `make docs`.

    python tools/site.py out/site-source

The front page is the head of the README, the gallery every picture of the pages, and the reference is that of
`make reference`. Links between pages stay as they are; those to the README lead to its page.
"""

import re
import shutil
import sys
from pathlib import Path

from reference import write as write_reference

ROOT = Path(__file__).parents[1]

PAGES = {"README.md": "about.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
"""Pages at the top of the repository, and their names in the site."""

FOLDERS = {
    "docs": ("md", "png", "json", "svg"),
    "mjcf": ("md", "png", "xml"),
    "examples": ("py", "toml"),
    "notebooks": ("ipynb",),
}
"""Folders, and the kinds of files that pages link to."""

STYLE = ".md-typeset td code { word-break: normal; }  /* words of a table stay whole; a wide one scrolls */\n"

PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)]+\.(?:png|svg))\)")


def main(target: Path) -> None:
    """Write the source into a folder, which is emptied first."""
    shutil.rmtree(target, ignore_errors=True)
    for folder, kinds in FOLDERS.items():
        for path in sorted(ROOT.glob(f"{folder}/**/*")):
            if path.suffix[1:] in kinds and "reference" not in path.parts:
                _copy(path, target / path.relative_to(ROOT))
    for name, page in PAGES.items():
        _copy(ROOT / name, target / page)
    shutil.copy(ROOT / "khep_twin/assets/web/icon.svg", target / "docs/icon.svg")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (target / "index.md").write_text(_front(readme), encoding="utf-8")
    (target / "site.css").write_text(STYLE, encoding="utf-8")
    (target / "gallery.md").write_text(_gallery(target), encoding="utf-8")
    write_reference(target / "reference")
    (target / "reference.md").write_text(
        "# Reference\n\nThe [reference of every public function and class](reference/index.html) is "
        "generated from the docstrings.\n",
        encoding="utf-8",
    )


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
    to.write_text(text, encoding="utf-8")


def _front(readme: str) -> str:
    """Return the front page: one picture, one sentence, two commands, and where to go on."""
    title, sentence, picture = readme.split("\n\n")[:3]
    (commands, *_) = re.findall(r"```sh\n.*?```", readme, re.DOTALL)
    return (
        f"---\ntitle: Khepera on MuJoCo\nhide: [navigation, toc]\n---\n{title}\n\n{sentence}\n\n"
        f"{picture}{{ width=560 }}\n\n{commands}\n\n"
        "[Tutorial](docs/tutorial.md){ .md-button .md-button--primary } "
        "[All that it does](about.md){ .md-button } [Gallery](gallery.md){ .md-button }\n"
    )


def _gallery(target: Path) -> str:
    """Return a page of every picture, with its description and the page that it is on."""
    seen: set[Path] = set()
    parts = ["---\nhide: [toc]\n---\n# Gallery\n\nAll pictures of the pages, each with a link to its page.\n"]
    for page in sorted(target.rglob("*.md")):
        text, there = page.read_text(encoding="utf-8"), page.relative_to(target)
        title = text.partition("\n")[0].removeprefix("# ")
        for words, link in PICTURE.findall(text):
            picture = (page.parent / link).resolve()
            if page.name not in ("index.md", "gallery.md") and picture not in seen and picture.exists():
                seen.add(picture)
                path = picture.relative_to(target.resolve())
                parts.append(f"![{words}]({path}){{ width=480 }}\n\n{words} ([{title}]({there})).\n")
    return "\n".join(parts)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
