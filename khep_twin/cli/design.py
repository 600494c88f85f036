"""`khep-twin design`: the designer and panel in a page of the browser."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from khep_twin.cli.options import complain, usage
from khep_twin.files.atomic import resolved
from khep_twin.signals import stopping


def design(
    file: Annotated[
        Path | None,
        typer.Argument(help="Playpen file to open; it may still have to be made. By default a new one."),
    ] = None,
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen at; port 0 for any free one.")
    ] = "127.0.0.1:0",
    allow_remote: Annotated[
        bool,
        typer.Option("--allow-remote", help="Let other machines reach it, too: anyone with the address."),
    ] = False,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the page's address.")] = False,
) -> None:
    """Open a page to build playpens and watch robots.

    The browser shows it until the command is stopped.

    It reads and writes files below the current folder only. Standard output has one line, the page's address
    with the token that opens it.
    """
    from khep_twin.web.server import Server

    folder = Path.cwd()
    name = None
    if file is not None:
        if not resolved(file).is_relative_to(resolved(folder)):
            raise usage(f"{file}: outside the folder; expected a file below {folder}, or to start there")
        name = str(resolved(file).relative_to(resolved(folder)))
    with stopping() as stop:
        server = Server(folder, name, listen, allow_remote=allow_remote, complain=complain)
        if allow_remote:
            complain("anyone with this address may do all that you may; it is not encrypted")
        how = "open this page in a browser" if no_browser else "the browser opens this page"
        complain(f"the designer runs for the playpens in {folder}; {how}; Ctrl-C ends it")
        typer.echo(server.url)
        if not no_browser:
            # Others can read the arguments of a process.
            webbrowser.open(server.url_once)
        server.serve(stop)
