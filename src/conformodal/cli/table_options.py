"""The options that say how a CSV file is written, of every command that reads one."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

_reading = partial(typer.Option, rich_help_panel="How a CSV file is written")
Separator = Annotated[str | None, _reading("--sep", help="Separator; recognised by default.")]
DecimalMark = Annotated[str | None, _reading("--decimal", help="Mark before decimals; recognised by default.")]
ThousandsMark = Annotated[str | None, _reading("--thousands", help="Mark between thousands; none by default.")]
NaValues = Annotated[
    list[str] | None, _reading("--na-values", "--na", help="Text that means a missing value; repeatable.")
]
DateFormats = Annotated[
    list[str] | None, _reading("--date", help="COLUMN=FORMAT of dates, such as 'sold=%d.%m.%y'; repeatable.")
]
