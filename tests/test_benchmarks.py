"""Benchmarks run by hand, too long for a test: here every name that they import is there."""

import ast
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
FILES = sorted(path.relative_to(BENCHMARKS) for path in BENCHMARKS.rglob("*.py"))


def imported(tree):
    """Modules and names of a file, and of the scripts that it holds as text."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and not node.level:
            yield from ((node.module, alias.name) for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and "import" in node.value:
            with suppress(SyntaxError):
                yield from imported(ast.parse(node.value))


@pytest.mark.parametrize("path", FILES, ids=str)
def test_every_name_that_a_benchmark_imports_is_there(path):
    names = [
        (module, name)
        for module, name in imported(ast.parse((BENCHMARKS / path).read_text()))
        if module.split(".")[0] == "conformodal"
    ]
    missing = []
    for module, name in names:
        if not hasattr(import_module(module), name):
            with suppress(ModuleNotFoundError):  # a module of the package
                import_module(f"{module}.{name}")
                continue
            missing.append(f"{module}.{name}")
    assert not missing
