"""Print the oldest release that the project allows of each package, as constraints for pip.

python scripts/oldest.py > oldest.txt
pip install --constraint oldest.txt --editable '.[train,arrow,save,hub,networks,ray,ros]' --group dev

The extra view is left out: its package needs NumPy 2, and the oldest NumPy is 1.26.
"""

from __future__ import annotations

import re
import tomllib
from itertools import chain
from pathlib import Path

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
_NAME, _LEAST = re.compile(r"[A-Za-z0-9._-]+"), re.compile(r"(?:>=|==)\s*([^,;\s]+)")


class ConstraintError(ValueError):
    """A requirement has no lower bound."""


def oldest(pyproject: str) -> list[str]:
    """Constraints, sorted by name.

    Parameters
    ----------
    pyproject
        The text of ``pyproject.toml``.

    Raises
    ------
    ConstraintError
        If a requirement of the package or of an extra says no lower bound.
    """
    project = tomllib.loads(pyproject)["project"]
    extras = project["optional-dependencies"].values()
    found = set()
    for requirement in chain(project["dependencies"], *extras):
        if requirement.startswith(f"{project['name']}["):  # extras that an extra brings
            continue
        name, least = _NAME.match(requirement), _LEAST.search(requirement.partition(";")[0])
        if name is None or least is None:
            raise ConstraintError(f"pyproject.toml: {requirement!r} says no oldest version; expected NAME>=VERSION")
        found.add(f"{name[0]}=={least[1]}")
    return sorted(found)


if __name__ == "__main__":
    print("\n".join(oldest(PYPROJECT.read_text(encoding="utf-8"))))
