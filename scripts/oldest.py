"""Print the oldest release that the project allows of each package, as constraints for pip.

python scripts/oldest.py > oldest.txt
pip install --constraint oldest.txt --editable '.[all]' --group dev
"""

from __future__ import annotations

import re
import tomllib
from itertools import chain
from pathlib import Path

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
_LEAST = re.compile(r"([A-Za-z0-9._-]+)(?:\[[^\]]*\])?\s*(?:>=|==)\s*([^,;\s]+)")


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
        least = _LEAST.fullmatch(requirement.split(",")[0].strip())
        if least is None:
            raise ConstraintError(f"pyproject.toml: {requirement!r} says no oldest version; expected NAME>=VERSION")
        found.add(f"{least[1]}=={least[2]}")
    return sorted(found)


if __name__ == "__main__":
    print("\n".join(oldest(PYPROJECT.read_text(encoding="utf-8"))))
