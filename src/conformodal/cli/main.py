"""The command ``conformodal``."""

from __future__ import annotations

from typing import Annotated

import typer

from .verbs import Verbs

app = typer.Typer(
    name="conformodal",
    cls=Verbs,
    help="Everywhere your camera could be, with a guarantee; and the one place that motion speaks for.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _version(value: bool) -> None:
    if value:
        from conformodal import __version__  # noqa: PLC0415 - the metadata of packages is read for it

        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def main(
    _: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False,
) -> None:
    """Everywhere your camera could be, with a guarantee; and the one place that motion speaks for."""
