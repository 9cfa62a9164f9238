"""Public names of the conformal core have an example, which runs, or name one."""

import importlib
import inspect
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def public(package):
    """Classes and functions by their public names."""
    module = importlib.import_module(package)
    values = {name: getattr(module, name) for name in module.__all__}
    return {name: value for name, value in values.items() if inspect.isclass(value) or inspect.isroutine(value)}


def has_example(value):
    parts = [value, *(vars(value).values() if inspect.isclass(value) else ())]
    return any(">>>" in (inspect.getdoc(part) or "") for part in parts)


@pytest.mark.parametrize("package", ["conformodal", "conformodal.conformal"])
def test_public_names_have_an_example_or_name_one(package):
    core = public("conformodal.conformal")
    for name, value in public(package).items():
        docstring = inspect.getdoc(value)
        others = [core.get(target) for target in re.findall(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", docstring)]
        files = [ROOT / path for path in re.findall(r"``((?:examples|docs)/[\w./-]+)``", docstring)]
        assert has_example(value) or files or any(other and has_example(other) for other in others), name
        for path in files:
            assert re.search(rf"\b{name}\b", path.read_text(encoding="utf-8")), f"{path.name} does not use {name}"
