"""Cars watched while they drive: rows from standard input, a growing file, MQTT or a recording, answers as they come.

Example:
    >>> import io
    >>> from avtorch.live import Batch, LineParser, LineSink, LiveSettings, LiveWatch, watch_source
    >>> watch = LiveWatch(LiveSettings(window=2.0, estimator="map"))
    >>> parser = LineParser(watch.counts)
    >>> class Lines:
    ...     identity = None
    ...     def batches(self, stop, start=None):
    ...         line = '{"car": "red", "time": %g, "accel_cmd": 0.1, "speed": %g}'
    ...         rows = [parser.row((line % (0.02 * i, 20.0 + 0.002 * i)).encode()) for i in range(120)]
    ...         yield Batch([row for row in rows if row is not None])
    >>> told = io.StringIO()
    >>> watch_source(Lines(), watch, [LineSink(told)])
    >>> told.getvalue().count("\\n"), watch.counts.to_dict()["refused"]
    (2, {})
"""

from avtorch.live.car import Answer as Answer
from avtorch.live.car import LiveSettings, LiveWatch
from avtorch.live.mqtt import MqttAddress, MqttSink, MqttSource
from avtorch.live.prometheus import Metrics as Metrics
from avtorch.live.source import REFUSED as REFUSED
from avtorch.live.source import Batch, FileSource, LineParser, PlayedLog, Row
from avtorch.live.source import Counts as Counts
from avtorch.live.source import Source as Source
from avtorch.live.source import StreamSource as StreamSource
from avtorch.live.watch_source import FileSink as FileSink
from avtorch.live.watch_source import KeptCars, LineSink, watch_source
from avtorch.live.watch_source import Sink as Sink

__all__ = [
    "Batch",
    "FileSource",
    "KeptCars",
    "LineParser",
    "LineSink",
    "LiveSettings",
    "LiveWatch",
    "MqttAddress",
    "MqttSink",
    "MqttSource",
    "PlayedLog",
    "Row",
    "watch_source",
]
