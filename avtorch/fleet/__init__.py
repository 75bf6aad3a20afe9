"""A fleet of cars: many logs checked, estimated and diagnosed on Dask, as rows of Parquet.

Example:
    >>> from avtorch import GLVDPlant, Leader, simulate
    >>> from avtorch.fleet import FleetSettings, read_rows, run_fleet
    >>> for car, lag in (("red", 0.3), ("blue", 1.6)):
    ...     run = simulate(Leader.default(start=30.0, duration=20.0, dt=0.05), plant=GLVDPlant(lag, 0.6))
    ...     run.log().write(f"{car}.csv")
    >>> quick = FleetSettings(steps=("check", "estimate"), estimator="map")
    >>> answer = run_fleet("*.csv", "out", settings=quick, workers=1)
    >>> [(car["car"], car["reason"]) for car in answer["cars"]]
    [('blue', 'below target'), ('red', 'sound')]
    >>> read_rows("out", "windows").num_rows
    20
"""

from avtorch.fleet.folder import read_rows
from avtorch.fleet.log_list import FleetLog, LogList, find_logs
from avtorch.fleet.run import run_fleet
from avtorch.fleet.settings import FleetSettings

__all__ = ["FleetLog", "FleetSettings", "LogList", "find_logs", "read_rows", "run_fleet"]
