"""``conformodal view``: the page of results, in a browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from conformodal.pipeline.errors import ResultsError

from .console import console, report_line
from .failures import report_errors


@report_errors()
def view(
    results: Annotated[Path, typer.Argument(help="Folder of run or demo, or a page.")],
    browser: Annotated[bool, typer.Option(help="Open it; --no-browser only says where it is.")] = True,
) -> None:
    """Open the page of results."""
    page = results if results.is_file() and results.suffix == ".html" else results / "report.html"
    if not page.is_file():
        raise ResultsError(f"{results}: holds no page of results (report.html)")
    if browser and not webbrowser.open(page.resolve().as_uri()):
        console.print("no browser was found here; open this file in one:")
    report_line(str(page.resolve()))
