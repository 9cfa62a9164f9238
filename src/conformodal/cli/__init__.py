"""The command line: one file per command."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command, or say what to install for it."""
    try:
        from .main import app  # noqa: PLC0415 - a table of numbers needs no command line
    except ModuleNotFoundError as exc:
        if (exc.name or "").startswith("conformodal"):
            raise
        extra = "table" if sys.argv[1:2] == ["table"] else "run"
        command = f"pip install 'conformodal[{extra}]'"
        sys.exit(f"error: the command line needs {exc.name}, which is not installed: {command}")
    app()
