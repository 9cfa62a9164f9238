"""Figures and the result page; the paper's figures are in :mod:`.paper`. Every name is imported when it is used."""

from typing import TYPE_CHECKING

from conformodal.core.late import late

if TYPE_CHECKING:
    from .comparison import Section, error_chart, write_comparison
    from .diagnosis import draw_diagnosis
    from .figures import error_figure, plan_figure, trajectory_figure
    from .live import LiveView, LiveViewError
    from .page import PageFigure, ReportContent, write_page
    from .quality import quality_plan, write_quality_page
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
    "quality_plan",
    "table1_markdown",
    "table1_notes",
    "table1_sections",
    "trajectory_figure",
    "write_comparison",
    "write_page",
    "write_quality_page",
]

__getattr__ = late(
    __name__,
    {
        **dict.fromkeys(("Section", "error_chart", "write_comparison"), ".comparison"),
        "draw_diagnosis": ".diagnosis",
        **dict.fromkeys(("error_figure", "plan_figure", "trajectory_figure"), ".figures"),
        **dict.fromkeys(("LiveView", "LiveViewError"), ".live"),
        **dict.fromkeys(("PageFigure", "ReportContent", "write_page"), ".page"),
        **dict.fromkeys(("quality_plan", "write_quality_page"), ".quality"),
        **dict.fromkeys(("table1_markdown", "table1_notes", "table1_sections"), ".table1"),
        "Thumbnails": ".thumbnails",
        **dict.fromkeys(("Viewer", "make_viewer"), ".viewer"),
    },
)
