"""A page of metrics for Prometheus, made from the watch's own numbers when it is asked for."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from typing import Any

from avtorch.errors import InputError
from avtorch.live.car import Answer, LiveCar, LiveWatch

INSTALL = "pip install 'avtorch[live]'"
CARS = 200
"""Cars with a value of their own, the first that were seen; each is a series that Prometheus keeps."""
BUCKETS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Bounds of the histogram of latencies [s]."""


class Metrics:
    """Metrics of `watch` under `http://HOST:PORT/metrics`, served by a thread until `close`; `port` 0: a free one.

    Raises `InputError` where prometheus-client is missing, and for a port that is taken.
    """

    def __init__(self, watch: LiveWatch, host: str, port: int) -> None:
        if importlib.util.find_spec("prometheus_client") is None:
            raise InputError(f"--prometheus needs prometheus-client, which is not installed: {INSTALL}")
        from prometheus_client import CollectorRegistry, Histogram, start_http_server

        self.watch = watch
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)  # type: ignore[arg-type]
        about = "From the arrival of the row that ended a window to its answer's being written"
        self._latency = Histogram("avtorch_latency_seconds", about, buckets=BUCKETS, registry=registry)
        try:
            self._server, self._thread = start_http_server(port, addr=host, registry=registry)
        except (OSError, OverflowError) as fault:
            why = fault.strerror if isinstance(fault, OSError) else fault
            raise InputError(f"--prometheus: {host}:{port} cannot be served ({why})") from None
        self.port = int(self._server.server_port)

    def collect(self) -> Iterator[Any]:
        """The numbers of the watch, as Prometheus asks for them, by another thread than the one that counts."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        counts, cars = self.watch.counts, list(self.watch.cars.values())
        plain = {"rows": "Rows taken in", "reordered": "Rows put in their place", "windows": "Windows answered"}
        for name, about in plain.items():
            yield CounterMetricFamily(f"avtorch_{name}", about, value=getattr(counts, name))
        refused = CounterMetricFamily("avtorch_refused", "Rows and messages left out", labels=["kind"])
        for kind, number in counts.refused.copy().items():
            refused.add_metric([kind], number)
        yield refused
        alerts = CounterMetricFamily("avtorch_alerts", "Windows with an alert", labels=["detector"])
        for detector, number in counts.alerts.copy().items():
            alerts.add_metric([detector], number)
        yield alerts
        yield GaugeMetricFamily("avtorch_cars", "Cars seen", value=len(cars))
        about = f"P(string stable) after the last window, of the first {CARS} cars"
        stable = GaugeMetricFamily("avtorch_p_string_stable", about, labels=["car"])
        for car in cars[:CARS]:
            if car.windows:
                stable.add_metric([car.name], car.p_string_stable)
        yield stable

    def answered(self, answer: Answer, car: LiveCar, seconds: float | None) -> None:
        """For `watch_source`."""
        if seconds is not None:
            self._latency.observe(seconds)

    def close(self) -> None:
        """End the page."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
