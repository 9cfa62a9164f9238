"""Pages from templates: one HTML file each, readable without a network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from conformodal.core.extras import require_extra
from conformodal.core.files import write_whole
from conformodal.core.words import counted

with require_extra("run", "a page of results"):
    from jinja2 import Environment, PackageLoader


def render_page(path: Path, template: str, **content: Any) -> None:
    """Write a page; what is put into it is escaped unless the template says that it is safe."""
    environment = Environment(loader=PackageLoader("conformodal.report"), autoescape=True, trim_blocks=True)
    environment.filters["counted"] = counted
    write_whole(path, environment.get_template(f"{template}.html.j2").render(**content))
