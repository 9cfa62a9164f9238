"""Pages of results: one HTML file each, with everything in it, readable without a network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from conformodal.core.extras import require_extra
from conformodal.core.files import write_whole
from conformodal.core.words import counted

with require_extra("run", "a page of results"):
    from jinja2 import Environment, PackageLoader

METHOD_LABELS = {
    "online": "online, as a robot gets it",
    "smoothed": "smoothed, with hindsight",
    "hindsight": "hindsight, not smoothed",
    "greedy": "the paper's greedy answer",
    "classical": "classical regressor",
}


def write_page(
    path: Path, title: str, summary: list[str], metrics: dict[str, Any], viewer: dict[str, Any] | None = None
) -> None:
    """Write the page of a run.

    `metrics` is the content of ``metrics.json``, `viewer` of :func:`~conformodal.report.viewer.make_viewer`.
    """
    errors, configuration = metrics.get("errors") or {}, metrics.get("configuration") or {}
    paths, image = metrics.get("path_coverage"), metrics.get("coverage")
    by_evidence = {}
    if paths and image:
        by_evidence["the image alone"] = {**image, "coverage": image["joint_coverage"]}
        by_evidence |= {"the frames so far": paths.get("online"), "all frames": paths.get("hindsight")}
    render_page(
        path,
        "page",
        title=title,
        summary=summary,
        record=metrics,
        unit=configuration.get("unit", "m"),
        asked=None if "alpha" not in configuration else 1 - configuration["alpha"],
        viewer=viewer,
        errors=[(label, errors[name]) for name, label in METHOD_LABELS.items() if name in errors],
        baseline=errors.get("classical", {}).get("rmse_m"),
        coverage=image,
        paths=[(name, row) for name, row in by_evidence.items() if row],
    )


def render_page(path: Path, template: str, **content: Any) -> None:
    """Write a page; what is put into it is escaped unless the template says that it is safe."""
    environment = Environment(loader=PackageLoader("conformodal.report"), autoescape=True, trim_blocks=True)
    environment.filters["counted"] = counted
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ": ")}  # a run has a thousand frames
    write_whole(path, environment.get_template(f"{template}.html.j2").render(**content))
