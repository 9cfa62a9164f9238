"""Figures and the result page; the paper's figures are in :mod:`.paper`."""

from .diagnosis import draw_diagnosis
from .figures import error_figure, plan_figure, trajectory_figure
from .page import PageFigure, ReportContent, write_page

__all__ = [
    "PageFigure",
    "ReportContent",
    "draw_diagnosis",
    "error_figure",
    "plan_figure",
    "trajectory_figure",
    "write_page",
]
