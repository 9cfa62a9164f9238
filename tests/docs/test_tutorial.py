"""The tutorial's code runs, and prints what the page says (numbers may differ a little between versions)."""

import contextlib
import io
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "tutorial.md"
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def test_the_tutorial_runs_and_prints_what_it_says():
    names = {}
    printed = io.StringIO()
    expected = []
    for kind, block in re.findall(r"```(python|text)\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        if kind == "text":
            expected.append(block)
            continue
        with contextlib.redirect_stdout(printed):
            exec(block, names)
    said, found = "".join(expected), printed.getvalue()
    assert NUMBER.sub("#", found) == NUMBER.sub("#", said)
    pairs = zip(NUMBER.findall(found), NUMBER.findall(said), strict=True)
    for a, b in pairs:
        assert float(a) == pytest.approx(float(b), rel=0.2, abs=10 if "." not in b else 0.03)
    assert names["figure"].axes
