"""The paper's table 1: less data, other networks, noise; against every baseline, over seeds."""

from .conditions import ROWS, Row, TrainingTask, tasks_of
from .summary import main_table, method_table, tidy
from .work import Table1Worker

__all__ = ["ROWS", "Row", "Table1Worker", "TrainingTask", "main_table", "method_table", "tasks_of", "tidy"]
