"""`avtorch watch`: cars monitored while they drive."""

from __future__ import annotations

import hashlib
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Group, Parameter

from avtorch.cli import arguments as arg
from avtorch.cli.talk import Talk
from avtorch.errors import InputError, quoted

if TYPE_CHECKING:
    from avtorch.live import Counts, KeptCars, LineParser, LiveWatch, Sink, Source

SOURCE = Group("Source", sort_key=7)


def watch(
    source: Annotated[str, Parameter(allow_leading_hyphen=True)],
    /,
    *,
    follow: Annotated[bool, arg.option("Go on with what is written to the file later.", SOURCE)] = False,
    rate: Annotated[
        float | None,
        arg.above_zero("Play a recording this many times faster than recorded; default: at once.", group=SOURCE),
    ] = None,
    car: Annotated[
        str | None, arg.option("Name of the car where rows have none; default: car, or the file's.", SOURCE)
    ] = None,
    map: arg.Columns = None,
    unit: arg.Units = None,
    lateness: Annotated[
        float, arg.zero_or_more("How far a row may come behind newer ones and still count [s].", "s", group=SOURCE)
    ] = 0.05,
    cars: Annotated[int, arg.whole("Cars at most; rows of others are counted.", group=SOURCE)] = 1000,
    window: arg.Window = 2.0,
    form: arg.Form = "auto",
    estimator: Annotated[
        Literal["auto", "map", "sgld", "importance"],
        arg.option(
            "Posterior mode, SGLD or importance sampling; auto: the mode where jerk is measured, else"
            " importance sampling."
        ),
    ] = "auto",
    mode: arg.Mode = "lambda",
    tau: arg.TimeGap = 1.0,
    gains: arg.Gains = "1.5,1.5,-0.8",
    accepted: arg.Accepted = "0.3,1.0",
    seed: arg.Seed = 0,
    state: Annotated[
        Path | None,
        arg.option(
            "Folder for the cars' states; the same command goes on from there.", arg.OUTPUT, converter=arg.local_folder
        ),
    ] = None,
    out: Annotated[
        str | None, arg.option("File or mqtt://HOST:PORT/TOPIC for the answers; default: standard output.", arg.OUTPUT)
    ] = None,
    prometheus: Annotated[
        str | None, arg.option("[HOST:]PORT for metrics; the host is 127.0.0.1 by default.", arg.OUTPUT)
    ] = None,
    quiet: arg.Quiet = False,
) -> None:
    """Watch cars while they drive: belief, alerts and P(string stable) of every window, one line of JSON each.

    Messages that are corrupt, doubled or too late are counted and left out; a count of them is printed on stderr at the
    end. Ctrl-C ends the watch; with --state the same command goes on, to the bit.

    Parameters
    ----------
    source
        A file of JSON lines or CSV, or - for standard input; a recording (ROS 2 bag, MCAP, MDF, ...) or Parquet, which
        is played back; or mqtt://HOST:PORT/TOPIC. A row has time, accel_cmd, accel or speed, and car where there are
        several.
    """
    k = arg.three_gains(gains)
    sound = arg.accepted_pair(accepted)
    address = None if prometheus is None else host_and_port(prometheus)

    from avtorch.live import Counts, KeptCars, LineParser, LiveSettings, LiveWatch, Metrics, watch_source

    settings = LiveSettings(
        window=window,
        form=form,
        estimator=estimator,
        mode=mode,
        time_gap=tau,
        gains=k,
        accepted=sound,
        lateness=lateness,
        cars=cars,
        seed=seed,
    )
    talk, counts, stop = Talk(json=False, quiet=quiet), Counts(), Event()
    monitor = LiveWatch(settings, counts)
    parser = LineParser(counts, map=map, unit=unit, car=car or "car")
    with ExitStack() as open_:
        if state is not None:
            from avtorch.io import sole_use

            open_.enter_context(sole_use(state, work="avtorch watch"))
        rows = _source(source, parser, follow=follow, rate=rate, car=car, map=map, unit=unit, state=state)
        kept = None if state is None else KeptCars(state, rows.identity)
        sink = _sink(out, kept, stop, source)
        open_.callback(sink.close)
        answered = None
        if address is not None:
            metrics = Metrics(monitor, *address)
            open_.callback(metrics.close)
            answered = metrics.answered
            talk.err.print(f"Metrics: http://{address[0]}:{metrics.port}/metrics", highlight=False)
        with stopped_by_signals(stop):
            try:
                watch_source(rows, monitor, [sink], stop=stop, kept=kept, answered=answered)
            finally:
                # nothing is told of a watch that was refused before its first row
                begun = counts.rows or counts.refused or sys.exc_info()[0] is None
                for line in told(monitor, counts, kept) if begun else ():
                    talk.err.print(line, markup=False, highlight=False, soft_wrap=True)


def _source(
    source: str,
    parser: LineParser,
    *,
    follow: bool,
    rate: float | None,
    car: str | None,
    map: list[str] | None,
    unit: list[str] | None,
    state: Path | None,
) -> Source:
    """What `SOURCE` names. Raises `InputError` for options that it has no use for."""
    from avtorch.io.formats import is_recording
    from avtorch.live import FileSource, MqttAddress, MqttSource, PlayedLog, StreamSource
    from avtorch.live.mqtt import is_mqtt

    played = source != "-" and not is_mqtt(source) and (is_recording(source) or source.endswith((".parquet", ".pq")))
    if rate is not None and not played:
        raise InputError("--rate: has a meaning for a recording alone, which is played back; leave it out")
    if follow and (played or source == "-" or is_mqtt(source)):
        raise InputError("--follow: has a meaning for a file of lines alone; leave it out")
    if source == "-":
        if sys.stdin is None:
            raise InputError("-: standard input is closed; needs a file, a topic, or rows by a pipe")
        return StreamSource(parser, sys.stdin.fileno())
    if is_mqtt(source):
        # by its folder: the broker keeps for the next run what comes between two of them
        folder = None if state is None else hashlib.sha256(os.fsencode(state.absolute())).hexdigest()[:16]
        return MqttSource(MqttAddress.of(source), parser, client_id=folder and f"avtorch-{folder}")
    if played:
        return PlayedLog(source, map=map, unit=unit, rate=rate, car=car)
    return FileSource(source, parser, follow=follow)


def _sink(out: str | None, kept: KeptCars | None, stop: Event, source: str) -> Sink:
    from avtorch.live import FileSink, LineSink, MqttAddress, MqttSink
    from avtorch.live.mqtt import is_mqtt

    if out is None:
        return LineSink()
    if is_mqtt(out):
        return MqttSink(MqttAddress.of(out), stop)
    if arg.is_address(out):
        raise InputError(f"--out: found {quoted(out)}; needs a file of this machine, or mqtt://HOST:PORT/TOPIC")
    if _are_one_file(source, out):
        raise InputError(f"--out: {quoted(out)} is the source itself; needs another name")
    return FileSink(out, resume=kept is not None and kept.same_source)


def _are_one_file(source: str, out: str) -> bool:
    try:
        return os.path.samefile(source, out)
    except (OSError, ValueError):  # not there yet, or a source that is no file
        return False


def host_and_port(text: str) -> tuple[str, int]:
    """The address of `--prometheus`. Raises `InputError` where it is none."""
    host, _, port = text.rpartition(":")
    if not port.isascii() or not port.isdecimal() or int(port) > 65535:
        raise InputError(f"--prometheus: found {quoted(text)}, needs a port, or HOST:PORT, such as 9100")
    return host or "127.0.0.1", int(port)


@contextmanager
def stopped_by_signals(stop: Event) -> Iterator[None]:
    """Within it the first Ctrl-C or SIGTERM sets `stop`, so that no window is left half done; a second interrupts."""
    before = {}

    def on(number: int, frame: object) -> None:
        stop.set()
        for each, handler in before.items():
            signal.signal(each, handler)

    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, on)
    except ValueError:  # not in the main thread, where no signal arrives either
        yield
        return
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def told(monitor: LiveWatch, counts: Counts, kept: KeptCars | None) -> list[str]:
    """What came of the watch, for people."""
    from avtorch.live import REFUSED

    cars = len(monitor.cars)
    lines = [f"{counts.rows} rows of {cars} car{'s' * (cars != 1)}, {counts.windows} windows"]
    if counts.alerts:
        lines[0] += ", alerts: " + ", ".join(f"{name} {many}" for name, many in sorted(counts.alerts.items()))
    if counts.reordered:
        lines.append(f"{counts.reordered} rows were out of order and put in their place")
    for kind, many in sorted(counts.refused.items(), key=lambda item: -item[1]):
        lines.append(f"left out: {many} {kind} ({REFUSED.get(kind, kind)})")
    if counts.repeated:
        lines.append(f"{counts.repeated} windows had been written before")
    if kept is not None:
        lines.append(f"state kept in {kept.folder}: the same command goes on from there")
    return lines
