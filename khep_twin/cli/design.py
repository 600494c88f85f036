"""`khep-twin design`: the playpen designer and robot panel, as a web page."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from khep_twin.cli.options import notify, usage
from khep_twin.files.atomic import resolve
from khep_twin.process.signals import stopping


def design(
    file: Annotated[
        Path | None, typer.Argument(help="Playpen file to open or create; by default a new playpen.")
    ] = None,
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen at; port 0 for any free port.")
    ] = "127.0.0.1:0",
    allow_remote: Annotated[
        bool, typer.Option("--allow-remote", help="Also let other machines connect: anyone with the address.")
    ] = False,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the page's address.")] = False,
) -> None:
    """Open a page to build playpens and watch robots.

    The page works until the command is stopped.

    It reads and writes files below the current folder only. Standard output has one line, the page's address
    with its access token.
    """
    from khep_twin.web.server import Server

    folder = Path.cwd()
    name = None
    if file is not None:
        if not resolve(file).is_relative_to(resolve(folder)):
            raise usage(f"{file}: outside the folder; expected a file below {folder}, or a start there")
        name = str(resolve(file).relative_to(resolve(folder)))
    with stopping() as stop:
        server = Server(folder, name, listen, allow_remote=allow_remote, report=notify)
        if allow_remote:
            notify("anyone with this address may do all that you may; it is not encrypted")
        instruction = "open this page in a browser" if no_browser else "the browser opens this page"
        notify(f"the designer runs for the playpens in {folder}; {instruction}; Ctrl-C ends it")
        typer.echo(server.url)
        if not no_browser:
            # Other users can read the arguments of a process, so this address opens the page once only.
            webbrowser.open(server.one_time_url)
        server.serve(stop)
