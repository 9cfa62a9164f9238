"""The command ``conformodal``."""

from __future__ import annotations

from typing import Annotated

import typer

from conformodal import __version__

from .calibrate import calibrate
from .data import app as data_app
from .demo import demo
from .evaluate import evaluate
from .reproduce import app as reproduce_app
from .run import run
from .train import train

app = typer.Typer(
    name="conformodal",
    help="Everywhere your camera could be, with a guarantee; and the one place that motion speaks for.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _version(value: bool) -> None:
    if value:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def main(
    _: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False,
) -> None:
    """Everywhere your camera could be, with a guarantee; and the one place that motion speaks for."""


for command in (demo, train, calibrate, run, evaluate):
    app.command()(command)
app.add_typer(data_app, name="data")
app.add_typer(reproduce_app, name="reproduce")
