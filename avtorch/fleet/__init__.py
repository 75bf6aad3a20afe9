"""A fleet of cars: many logs checked, estimated and diagnosed on Dask, as rows of Parquet."""

from avtorch.fleet.folder import read_rows
from avtorch.fleet.log_list import FleetLog, LogList, find_logs
from avtorch.fleet.run import run_fleet
from avtorch.fleet.settings import FleetSettings

__all__ = ["FleetLog", "FleetSettings", "LogList", "find_logs", "read_rows", "run_fleet"]
