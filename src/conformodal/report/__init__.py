"""Figures and the result page. Every name is imported when it is used."""

from typing import TYPE_CHECKING

from conformodal.core.late import late

if TYPE_CHECKING:
    from .diagnosis import draw_diagnosis
    from .figures import error_figure, plan_figure, trajectory_figure
    from .live import LiveView, LiveViewError
    from .page import PageFigure, ReportContent, write_page
    from .quality import quality_plan, write_quality_page
    from .thumbnails import Thumbnails
    from .viewer import Viewer, make_viewer

__all__ = [
    "LiveView",
    "LiveViewError",
    "PageFigure",
    "ReportContent",
    "Thumbnails",
    "Viewer",
    "draw_diagnosis",
    "error_figure",
    "make_viewer",
    "plan_figure",
    "quality_plan",
    "trajectory_figure",
    "write_page",
    "write_quality_page",
]

__getattr__ = late(
    __name__,
    {
        "draw_diagnosis": ".diagnosis",
        **dict.fromkeys(("error_figure", "plan_figure", "trajectory_figure"), ".figures"),
        **dict.fromkeys(("LiveView", "LiveViewError"), ".live"),
        **dict.fromkeys(("PageFigure", "ReportContent", "write_page"), ".page"),
        **dict.fromkeys(("quality_plan", "write_quality_page"), ".quality"),
        "Thumbnails": ".thumbnails",
        **dict.fromkeys(("Viewer", "make_viewer"), ".viewer"),
    },
)
