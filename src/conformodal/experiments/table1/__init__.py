"""The paper's table 1: less data, other networks, noise; against every baseline, over seeds."""

from .bin_runs import bin_runs
from .conditions import NETWORKS, Row, TrainingTask, rows_of, run_name, task_key, tasks_of
from .size_against_error import size_table
from .softmaxes import Softmaxes
from .summary import METHODS, Record, tidy, write_json, write_parquet
from .tables import Table, cost_table, lead_table, main_table, method_table, paper_region_table, region_table
from .work import Table1Worker

__all__ = [
    "METHODS",
    "NETWORKS",
    "Record",
    "Row",
    "Softmaxes",
    "Table",
    "Table1Worker",
    "TrainingTask",
    "bin_runs",
    "cost_table",
    "lead_table",
    "main_table",
    "method_table",
    "paper_region_table",
    "region_table",
    "rows_of",
    "run_name",
    "size_table",
    "task_key",
    "tasks_of",
    "tidy",
    "write_json",
    "write_parquet",
]
