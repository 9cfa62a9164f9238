"""Figures and the result page; the paper's figures are in :mod:`.paper`."""

from .comparison import Section, error_chart, write_comparison
from .diagnosis import draw_diagnosis
from .figures import error_figure, plan_figure, trajectory_figure
from .live import LiveView, LiveViewError
from .page import PageFigure, ReportContent, write_page
from .table1 import table1_markdown, table1_notes, table1_sections
from .thumbnails import Thumbnails
from .viewer import Viewer, make_viewer

__all__ = [
    "LiveView",
    "LiveViewError",
    "PageFigure",
    "ReportContent",
    "Section",
    "Thumbnails",
    "Viewer",
    "draw_diagnosis",
    "error_chart",
    "error_figure",
    "make_viewer",
    "plan_figure",
    "table1_markdown",
    "table1_notes",
    "table1_sections",
    "trajectory_figure",
    "write_comparison",
    "write_page",
]
