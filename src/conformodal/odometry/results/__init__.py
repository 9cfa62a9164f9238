"""Results on disk: trajectories, regions and metrics, written whole or not at all."""

from .parquet import read_region_parquet, write_region_parquet
from .provenance import provenance
from .records import METRICS, iter_region_records, read_region_records, records_contain
from .runs import read_metrics, read_trajectories, read_unfinished, write_metrics, write_run
from .statistics import RegionStatistics
from .writer import ResultsWriter

__all__ = [
    "METRICS",
    "RegionStatistics",
    "ResultsWriter",
    "iter_region_records",
    "provenance",
    "read_metrics",
    "read_region_parquet",
    "read_region_records",
    "read_trajectories",
    "read_unfinished",
    "records_contain",
    "write_metrics",
    "write_region_parquet",
    "write_run",
]
