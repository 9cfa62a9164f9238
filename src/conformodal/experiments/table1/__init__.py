"""The paper's table 1: less data, other networks, noise; against every baseline, over seeds."""

from .bins import bin_runs
from .conditions import NETWORKS, Row, TrainingTask, rows_of, task_key, tasks_of
from .sizes import size_table
from .summary import METHODS, Record, tidy, write_json, write_parquet
from .tables import Table, cost_table, main_table, method_table, region_table
from .work import Table1Worker, run_name

__all__ = [
    "METHODS",
    "NETWORKS",
    "Record",
    "Row",
    "Table",
    "Table1Worker",
    "TrainingTask",
    "bin_runs",
    "cost_table",
    "main_table",
    "method_table",
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
