"""Figures and the result page; the paper's figures are in :mod:`.paper`."""

from .comparison import Section, error_chart, write_comparison
from .diagnosis import draw_diagnosis
from .figures import error_figure, plan_figure, trajectory_figure
from .page import PageFigure, ReportContent, write_page

__all__ = [
    "PageFigure",
    "ReportContent",
    "Section",
    "draw_diagnosis",
    "error_chart",
    "error_figure",
    "plan_figure",
    "trajectory_figure",
    "write_comparison",
    "write_page",
]
