"""The result page: one HTML file with everything in it, readable without a network."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from conformodal.core.extras import require_extra
from conformodal.core.files import write_whole
from conformodal.core.words import counted

with require_extra("run", "a page of results"):
    from jinja2 import Environment, PackageLoader

PAGE = "report.html"
METHOD_LABELS = {
    "online": "online, as a robot gets it",
    "smoothed": "smoothed, with hindsight",
    "hindsight": "hindsight, not smoothed",
    "greedy": "the paper's greedy answer",
    "classical": "classical regressor",
}


@dataclass(frozen=True)
class PageFigure:
    """A figure: a name for its file, what stands above and below it, and the SVG."""

    name: str
    heading: str
    caption: str
    svg: str


@dataclass(frozen=True)
class ReportContent:
    """What goes on the page."""

    title: str
    summary: list[str]  # the first lines
    metrics: dict[str, Any]  # the content of ``metrics.json``
    figures: list[PageFigure] = field(default_factory=list)
    viewer: dict[str, Any] | None = None  # of :func:`~conformodal.report.viewer.make_viewer`, or None


def write_page(path: Path, content: ReportContent) -> None:
    """Write the page, and its figures as files under ``figures`` beside it."""
    for figure in content.figures:
        write_whole(path.parent / "figures" / f"{figure.name}.svg", figure.svg)
    errors = content.metrics.get("errors") or {}
    ordered = [(label, errors[name]) for name, label in METHOD_LABELS.items() if name in errors]
    baseline = errors.get("classical", {}).get("rmse_m")
    render_page(
        path,
        "page",
        title=content.title,
        content=content,
        record=content.metrics,
        viewer=content.viewer,
        errors=ordered,
        baseline=baseline,
        coverage=content.metrics.get("coverage"),
        paths=_path_rows(content.metrics),
    )


def _path_rows(metrics: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Rows of the image's region and of those from posteriors; empty without the latter."""
    paths, image = metrics.get("path_coverage"), metrics.get("coverage")
    if not paths or not image:
        return []
    image_row = {**image, "coverage": image["joint_coverage"]}
    named = {
        "the image alone": image_row,
        "the frames so far": paths.get("online"),
        "all frames": paths.get("hindsight"),
    }
    return [(name, row) for name, row in named.items() if row]


def render_page(path: Path, template: str, **content: Any) -> None:
    """Write a page; what is put into it is escaped unless the template says that it is safe."""
    environment = Environment(loader=PackageLoader("conformodal.report"), autoescape=True, trim_blocks=True)
    environment.filters["counted"] = counted
    write_whole(path, environment.get_template(f"{template}.html.j2").render(**content))
