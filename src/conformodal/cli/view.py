"""``conformodal view``: the page of results, in a browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from conformodal.model.errors import ResultsError

from .console import console, report_errors, report_line

_PAGES = ("report.html",)


@report_errors
def view(
    results: Annotated[Path, typer.Argument(help="Folder of run or demo, or a page.")],
    browser: Annotated[bool, typer.Option(help="Open it; --no-browser only says where it is.")] = True,
) -> None:
    """Open the page of results."""
    page = page_of(results)
    if browser and not webbrowser.open(page.resolve().as_uri()):
        console.print("no browser was found here; open this file in one:")
    report_line(str(page.resolve()))


def page_of(results: Path) -> Path:
    """The page in a folder of results."""
    if results.is_file() and results.suffix == ".html":
        return results
    found = [results / name for name in _PAGES if (results / name).is_file()]
    if not found:
        raise ResultsError(f"{results}: holds no page of results ({' or '.join(_PAGES)})")
    return found[0]
