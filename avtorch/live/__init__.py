"""Cars watched while they drive: rows from standard input, a growing file, MQTT or a recording, answers as they come.

Example:
    >>> import io
    >>> from avtorch.live import Batch, LineParser, LineSink, LiveSettings, LiveWatch, watch_source
    >>> watch = LiveWatch(LiveSettings(window=2.0, estimator="map"))
    >>> parser = LineParser(watch.counts)
    >>> class Lines:
    ...     name, identity = "lines", None
    ...     def batches(self, stop, start=None):
    ...         line = '{"car": "red", "time": %g, "accel_cmd": 0.1, "speed": %g}'
    ...         rows = [parser.row((line % (0.02 * i, 20.0 + 0.002 * i)).encode()) for i in range(120)]
    ...         yield Batch([row for row in rows if row is not None])
    >>> told = io.StringIO()
    >>> watch_source(Lines(), watch, [LineSink(told)])
    >>> told.getvalue().count("\\n"), watch.counts.to_dict()["refused"]
    (2, {})
"""

from avtorch.live.counts import REFUSED, Counts
from avtorch.live.kept_cars import KeptCars
from avtorch.live.line_parser import LineParser
from avtorch.live.line_source import FileSource, StreamSource
from avtorch.live.live_watch import Answer, LiveWatch
from avtorch.live.mqtt import MqttAddress, MqttSink, MqttSource
from avtorch.live.played_log import PlayedLog
from avtorch.live.prometheus import Metrics
from avtorch.live.settings import LiveSettings
from avtorch.live.sink import FileSink, LineSink, Sink
from avtorch.live.source import Batch, Row, Source, Stop
from avtorch.live.watch_source import watch_source

__all__ = [
    "REFUSED",
    "Answer",
    "Batch",
    "Counts",
    "FileSink",
    "FileSource",
    "KeptCars",
    "LineParser",
    "LineSink",
    "LiveSettings",
    "LiveWatch",
    "Metrics",
    "MqttAddress",
    "MqttSink",
    "MqttSource",
    "PlayedLog",
    "Row",
    "Sink",
    "Source",
    "Stop",
    "StreamSource",
    "watch_source",
]
