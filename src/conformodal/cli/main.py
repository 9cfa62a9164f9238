"""The command ``conformodal``.

Each command is imported when it runs, so that ``--help``, ``--version`` and wrong options import nothing heavy.
"""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperCommand
from typer.main import get_command

from conformodal.core.extras import require_extra

from .console import Command, Group, report_errors

# By command, which is also the name of its module: the first line of its help.
COMMANDS = {
    "demo": "Fly through a corridor of identical rooms, learn it, and localize the camera by conformal regions and "
    "motion.",
    "map": "Map videos without poses: write a recording to train on, and say whether it is to be trusted.",
    "train": "Train on a data set with poses, calibrate, and save the model.",
    "extend": "Extend a model by new recordings: each is answered first, its scores calibrate, then it joins the map.",
    "run": "Compute regions and the trajectory of sources with a saved model, frame by frame.",
    "evaluate": "Compare results with true poses: errors of every path and frame, and coverage.",
    "info": "Print what a saved model's regions hold, how large they are, and what to do next.",
    "monitor": "Test whether new recordings, or rows, are like those that calibrate; exit code 1 is an alarm.",
    "data": "Check or convert a data set.",
    "table": "Learn columns of a CSV file from the others (fit, the default), or write regions of new rows (predict).",
}
_EXTRAS = {
    "monitor": "table",
    "demo": "train",
    "train": "train",
    "table": "table",
    "map": "train",
}  # the others need 'run'
_HELP = "Every pose that an image may show, with a coverage guarantee; and the one that fits the motion."


class _LazyCommand(TyperCommand):
    """A command that is imported when its arguments are read."""

    def __init__(self, name: str) -> None:
        super().__init__(name, help=COMMANDS[name])

    def loaded(self) -> Any:
        """The command itself."""
        assert self.name is not None
        with require_extra(_EXTRAS.get(self.name, "run"), f"conformodal {self.name}"):
            module = import_module(f"{__package__}.{self.name}")
        app = getattr(module, "app", None) or typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        if not app.registered_commands:
            app.command(self.name)(getattr(module, self.name))
        for each in app.registered_commands:
            each.cls = Command
        command = get_command(app)
        command.name = self.name
        return command

    def make_context(self, *arguments: Any, **options: Any) -> Any:
        """The loaded command's: from here on it is the one that runs."""
        return self.loaded().make_context(*arguments, **options)


class _Commands(Group):
    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = {name: _LazyCommand(name) for name in COMMANDS}

    def invoke(self, ctx: Any) -> Any:
        """Parse, load and run a command; the one place where an error becomes a line and an exit code."""
        with report_errors():
            return super().invoke(ctx)


app = typer.Typer(name="conformodal", cls=_Commands, help=_HELP, no_args_is_help=True, pretty_exceptions_enable=False)


def _version(value: bool) -> None:
    if value:
        from conformodal import __version__  # noqa: PLC0415 - the metadata of packages is read for it

        typer.echo(__version__)
        raise typer.Exit


@app.callback(help=_HELP)
def main(
    _: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False,
) -> None:
    """Parse the options of all commands."""
