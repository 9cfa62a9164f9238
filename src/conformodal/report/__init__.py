"""Figures and the result page."""

from .figures import error_figure, plan_figure, trajectory_figure
from .page import ReportContent, write_page

__all__ = ["ReportContent", "error_figure", "plan_figure", "trajectory_figure", "write_page"]
