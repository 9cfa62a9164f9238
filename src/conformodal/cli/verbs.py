"""The verbs, each imported when it is run: ``--help``, ``--version`` and wrong options import nothing heavy."""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from conformodal.core.extras import MissingPackageError, require_extra

from .failures import explained


class _Verb(NamedTuple):
    """Where a verb is, its line in the list of verbs, and the extra that installs what it needs."""

    place: str
    help: str
    extra: str = "run"


VERBS = {
    "demo": _Verb(
        "demo:demo",
        "Fly through a corridor of identical rooms, learn it, and find the way by conformal regions and motion.",
        "train",
    ),
    "train": _Verb("train:train", "Train on a data set with poses, calibrate, and save the model.", "train"),
    "export": _Verb(
        "export:export",
        "Write a model anew with its network in ONNX, or in eight bits.",
        "train",
    ),
    "calibrate": _Verb(
        "calibrate:calibrate", "Give the chosen pose a radius that keeps a promise, calibrated on whole recordings."
    ),
    "run": _Verb(
        "run:run",
        "Find regions and the trajectory of a source with a saved model, frame by frame. "
        "Ctrl-C stops it, results kept.",
    ),
    "evaluate": _Verb(
        "evaluate:evaluate",
        "Compare results with the truth; pairs poses by time, within 0.01 s. Writes OUT/evaluation/metrics.json.",
    ),
    "view": _Verb("view:view", "Open the page of results."),
    "info": _Verb(
        "info:info",
        "Say what a saved model was trained on, what it guarantees, how large it is and how fast its network runs.",
    ),
    "data": _Verb("data:app", "Look at a data set, or convert it."),
}


class _Late(TyperCommand):
    """A verb that is imported when its arguments are read."""

    def __init__(self, name: str, verb: _Verb) -> None:
        super().__init__(name, help=verb.help)
        self._verb = verb

    def loaded(self) -> Any:
        """The command itself."""
        module, attribute = self._verb.place.split(":")
        try:
            with require_extra(self._verb.extra, f"conformodal {self.name}"):
                found = getattr(import_module(f"{__package__}.{module}"), attribute)
        except MissingPackageError as exc:
            said, code = explained(exc)
            typer.echo(f"error: {said}", err=True)
            raise typer.Exit(code) from None
        app = found
        if not isinstance(found, typer.Typer):
            app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
            app.command(self.name)(found)
        command = get_command(app)
        command.name = self.name
        _add_ranges(command)
        return command

    def make_context(self, *arguments: Any, **options: Any) -> Any:
        """The loaded command's: from here on it is the one that runs."""
        return self.loaded().make_context(*arguments, **options)


def _add_ranges(command: Any) -> None:
    """Have the help of each option that is a number end with its range."""
    from .options import range_of  # noqa: PLC0415 - the list of verbs needs no ranges, and they bring SciPy

    for option in command.params:
        allowed = range_of(option.name)
        if allowed is not None:
            option.help = f"{(option.help or '').rstrip('. ')}: {allowed}."
    for each in getattr(command, "commands", {}).values():
        _add_ranges(each)


class Verbs(TyperGroup):
    """The group of all verbs."""

    def list_commands(self, ctx: Any) -> list[str]:
        """All names, in the order of a first use."""
        return list(VERBS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A verb that is not imported yet."""
        return _Late(cmd_name, VERBS[cmd_name]) if cmd_name in VERBS else None
