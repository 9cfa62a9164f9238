"""Public names say what they are; those that most programs need have an example, which runs, or name one."""

import importlib
import inspect
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "conformodal"
WITH_EXAMPLES = ("conformodal", "conformodal.conformal")
PACKAGES = sorted(
    ".".join(path.parent.relative_to(SOURCE.parent).parts)
    for path in SOURCE.rglob("__init__.py")
    if "__all__" in path.read_text(encoding="utf-8")
)


def public(package):
    """Classes and functions by their public names."""
    module = importlib.import_module(package)
    found = {name: getattr(module, name) for name in getattr(module, "__all__", ())}
    return {name: value for name, value in found.items() if inspect.isclass(value) or inspect.isroutine(value)}


@pytest.mark.parametrize("package", PACKAGES)
def test_public_classes_and_functions_have_a_docstring_of_their_own(package):
    for name, value in public(package).items():
        said = value.__dict__.get("__doc__") if inspect.isclass(value) else value.__doc__
        assert said, name
        assert not said.startswith(f"{name}("), f"{name}: that is what dataclasses say"


def examples_of(value):
    """Sources of examples of a name: its own, of its methods, or of what its docstring names."""
    own = [value, *(vars(value).values() if inspect.isclass(value) else ())]
    return [said for said in map(inspect.getdoc, own) if said and ">>>" in said]


@pytest.mark.parametrize(("package", "name"), [(p, name) for p in WITH_EXAMPLES for name in public(p)])
def test_a_name_has_an_example_or_names_one(package, name):
    value = public(package)[name]
    said = inspect.getdoc(value)
    if examples_of(value):
        return
    others = [
        public("conformodal.conformal").get(target) for target in re.findall(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", said)
    ]
    files = [ROOT / path for path in re.findall(r"``((?:examples|docs)/[\w./-]+)``", said)]
    for path in files:
        assert re.search(rf"\b{name}\b", path.read_text(encoding="utf-8")), f"{path.name} does not use it"
    assert files or any(other is not None and examples_of(other) for other in others), "no example, and none is named"
