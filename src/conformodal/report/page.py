"""The result page: one HTML file with everything in it, readable without a network."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.extras import require_extra
from conformodal.core.files import write_whole

from .templating import render_page
from .viewer import Viewer

with require_extra("run", "a page of results"):
    from PIL import Image

_LABELS = {
    "online": "conformal, online: each pose when its frame comes, as a robot gets it",
    "smoothed": "conformal, with hindsight and smoothed (trajectory.tum)",
    "hindsight": "conformal, with hindsight, not smoothed",
    "greedy": "the paper's system: its greedy answer",
    "classical": "classical regressor on the same features",
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
    """What goes on the page.

    Attributes
    ----------
    title, summary
        First lines.
    metrics
        The content of ``metrics.json``.
    figures
        In order.
    viewer
        The results frame by frame, or None.
    image
        (caption, (h, w, 3) RGB) of the frame whose regions are shown, or None.
    """

    title: str
    summary: list[str]
    metrics: dict[str, Any]
    figures: list[PageFigure] = field(default_factory=list)
    viewer: Viewer | None = None
    image: tuple[str, npt.NDArray[np.uint8]] | None = None


def write_page(path: Path, content: ReportContent) -> None:
    """Write the page, and its figures as files under ``figures`` beside it."""
    for figure in content.figures:
        write_whole(path.parent / "figures" / f"{figure.name}.svg", figure.svg)
    errors = content.metrics.get("errors") or {}
    ordered = [(label, errors[name]) for name, label in _LABELS.items() if name in errors]
    baseline = errors.get("classical", {}).get("rmse_m")
    image = None if content.image is None else (content.image[0], _data_url(content.image[1]))
    render_page(
        path,
        "page",
        title=content.title,
        content=content,
        viewer=content.viewer,
        errors=ordered,
        baseline=baseline,
        image=image,
        coverage=content.metrics.get("coverage"),
        paths=_path_rows(content.metrics),
    )


def _path_rows(metrics: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Rows of the image's region and of those from posteriors; empty without the latter."""
    found, image = metrics.get("path_coverage"), metrics.get("coverage")
    if not found or not image:
        return []
    own = {**image, "coverage": image["joint_coverage"]}
    named = {"the image alone": own, "the frames so far": found.get("online"), "all frames": found.get("hindsight")}
    return [(name, row) for name, row in named.items() if row]


def _data_url(image: npt.NDArray[np.uint8]) -> str:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
