"""Pages of the site from notebooks/, with the outputs that the files hold; nothing is run.

Alternative texts of pictures are those of their cells (``alt`` in a cell's metadata). Needs the standard library only.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
PICTURES = {"image/svg+xml": "svg", "image/png": "png"}


def notebooks() -> list[str]:
    """Names of all notebooks."""
    return sorted(path.stem for path in FOLDER.glob("*.ipynb"))


def notebook_page(name: str) -> str:
    """The Markdown of a notebook: text, code, and what the code has said and drawn."""
    parts, n_pictures = [], 0
    for cell in _cells(name):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            if text := said(output):
                parts.append(f"```text\n{text.rstrip()}\n```")
            elif _picture(output):
                parts.append(f"![{cell['metadata']['alt']}]({name}-{n_pictures}.{_picture(output)})")
                n_pictures += 1
    where = f"This page is `notebooks/{name}.ipynb` of the repository, with the outputs of its last run."
    return "\n\n".join([*parts, f"*{where}*", ""])


def pictures() -> dict[str, bytes]:
    """All pictures of all notebooks, by their places on the site."""
    found: dict[str, bytes] = {}
    for name in notebooks():
        outputs = [output for cell in _cells(name) for output in cell.get("outputs", ()) if _picture(output)]
        for number, output in enumerate(outputs):
            found[f"notebooks/{name}-{number}.{_picture(output)}"] = _content(output["data"])
    return found


def said(output: dict[str, Any]) -> str:
    """What an output says in words; nothing for a picture."""
    if output["output_type"] == "stream":
        return "".join(output["text"])
    return "" if _picture(output) else "".join(output.get("data", {}).get("text/plain", ""))


def _cells(name: str) -> list[dict[str, Any]]:
    cells: list[dict[str, Any]] = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    return cells


def _picture(output: dict[str, Any]) -> str:
    """The suffix of an output's picture, or nothing."""
    return next((suffix for kind, suffix in PICTURES.items() if kind in output.get("data", {})), "")


def _content(data: dict[str, Any]) -> bytes:
    if "image/svg+xml" in data:
        return "".join(data["image/svg+xml"]).encode()
    return base64.b64decode("".join(data["image/png"]))
