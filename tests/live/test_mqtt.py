"""Rows and answers by MQTT, through mosquitto."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any
from unittest.mock import MagicMock

import pytest

from avtorch.errors import InputError
from avtorch.live import Answer, Counts, LineParser, LiveWatch, MqttAddress, MqttSink, MqttSource, watch_source
from avtorch.live.mqtt import UNACKNOWLEDGED
from tests.live.drives import fleet, until

mqtt = pytest.importorskip("paho.mqtt.client")

# Debian puts servers where a user's PATH does not look
PROGRAM = shutil.which("mosquitto", path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/usr/local/sbin"]))

needs_broker = pytest.mark.skipif(PROGRAM is None, reason="needs a broker: Debian's mosquitto")


@contextmanager
def broker(port: int, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    config = folder / "mosquitto.conf"
    config.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\nmax_queued_messages 100000\n")
    assert PROGRAM is not None
    process = subprocess.Popen([PROGRAM, "-c", str(config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        end = time.monotonic() + 20
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except OSError:
                assert time.monotonic() < end, "the broker does not answer"
                time.sleep(0.05)
        yield process
    finally:
        process.terminate()
        process.wait(20)


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    number = free_port()
    with broker(number, tmp_path):
        yield number


def client(port: int) -> Any:
    made = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    made.connect("127.0.0.1", port)
    made.loop_start()
    return made


@needs_broker
@pytest.mark.slow
def test_rows_in_answers_out(port: int) -> None:
    """Single rows, lists and lines; every fault counted exactly; a car named by its topic."""
    counts, stop = Counts(), Event()
    watch = LiveWatch(counts=counts)
    source = MqttSource(MqttAddress.of(f"mqtt://127.0.0.1:{port}/cars/+"), LineParser(counts))
    sink = MqttSink(MqttAddress.of(f"mqtt://127.0.0.1:{port}/answers"), stop)
    heard: list[dict[str, Any]] = []
    other = client(port)
    other.on_message = lambda client, data, message: heard.append(json.loads(message.payload))
    other.subscribe("answers", qos=1)
    # the watch turns its loops in the main thread of a program; here beside the test
    work = threading.Thread(target=watch_source, args=(source, watch, [sink]), kwargs={"stop": stop})
    work.start()
    rows = fleet(6.2)
    until(lambda: counts.rows == 0 and (other.publish("cars/x", b"{", qos=1), counts.refused["corrupt"])[1])
    # messages keep their order: behind this one no corrupt one is on its way any more
    other.publish("cars/x", b'{"car": "red"}', qos=1)
    until(lambda: counts.refused["incomplete"])
    corrupt = counts.refused["corrupt"]
    single = rows[:300]
    # two neighbours of one car change places, and one row comes 0.2 s behind its time, beyond the lateness of 0.05 s
    single[30], single[33] = single[33], single[30]
    single.insert(91, single.pop(61))
    for i, row in enumerate(single):
        other.publish("cars/single", json.dumps(row), qos=1)
        if i % 100 == 0:
            other.publish("cars/single", json.dumps(row), qos=1)
        if i % 60 == 0:
            other.publish("cars/single", json.dumps(row)[:20], qos=1)
    other.publish("cars/single", json.dumps({**rows[299], "speed": 1e9}), qos=1)
    other.publish("cars/list", json.dumps(rows[300:600]), qos=1)
    other.publish("cars/lines", "\n".join(json.dumps(row) for row in rows[600:]), qos=1)
    unnamed = {key: value for key, value in rows[0].items() if key != "car"}
    other.publish("cars/purple", json.dumps(unnamed), qos=1)
    until(lambda: counts.rows >= len(rows) and len(heard) >= 9)
    stop.set()
    work.join(20)
    sink.close()
    other.loop_stop()
    assert set(watch.cars) == {"red", "blue", "green", "cars/purple"}
    # one more of the car without a name, one less that was late
    assert counts.rows == len(rows)
    assert counts.reordered == 1
    expected = {"corrupt": corrupt + 5, "incomplete": 1, "doubled": 3, "late": 1, "implausible": 1}
    assert dict(counts.refused) == expected
    assert sorted((e["car"], e["window"]) for e in heard) == [
        (car, n) for car in ("blue", "green", "red") for n in (1, 2, 3)
    ]


@needs_broker
@pytest.mark.slow
def test_it_survives_the_brokers_restart(tmp_path: Path) -> None:
    port = free_port()
    counts, stop = Counts(), Event()
    watch = LiveWatch(counts=counts)
    source = MqttSource(MqttAddress.of(f"mqtt://127.0.0.1:{port}/cars"), LineParser(counts))
    work = threading.Thread(target=watch_source, args=(source, watch, []), kwargs={"stop": stop})
    rows = fleet(2.0)

    def sent(row: dict[str, Any]) -> bool:
        before = counts.rows
        with_it = client(port)
        with_it.publish("cars", json.dumps(row), qos=1).wait_for_publish(10)
        time.sleep(0.1)
        with_it.disconnect()
        with_it.loop_stop()
        return counts.rows > before

    with broker(port, tmp_path):
        work.start()
        until(lambda: sent(rows[0]))
    with broker(port, tmp_path):
        until(lambda: sent(rows[3]))
    stop.set()
    work.join(20)
    assert not work.is_alive()


@needs_broker
@pytest.mark.slow
def test_the_broker_keeps_what_comes_between_two_runs(port: int, tmp_path: Path) -> None:
    """By the command, with a state: messages sent while it was not there are not lost."""
    rows = fleet(8.0)
    half = len(rows) // 2
    command = [sys.executable, "-m", "avtorch.cli", "watch", f"mqtt://127.0.0.1:{port}/cars", "--state", "state"]
    command += ["--out", "out.jsonl"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    out = tmp_path / "out.jsonl"

    def written(least: int) -> bool:
        return out.exists() and out.read_bytes().count(b"\n") >= least

    other = client(port)
    first = subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE)
    # until it has subscribed nothing is kept for it; a row that comes twice is counted and changes nothing
    until(
        lambda: (other.publish("cars", json.dumps(rows[0]), qos=1), time.sleep(0.3), (tmp_path / "state").exists())[2]
    )
    time.sleep(2.0)
    other.publish("cars", json.dumps(rows[:half]), qos=1)
    until(lambda: written(3))
    first.terminate()
    _, err = first.communicate(timeout=60)
    assert first.returncode == 0, err
    other.publish("cars", json.dumps(rows[half:]), qos=1).wait_for_publish(10)
    second = subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE)
    until(lambda: written(9))
    second.terminate()
    _, err = second.communicate(timeout=60)
    other.loop_stop()
    assert f"{len(rows)} rows of 3 cars, 9 windows" in err.decode()


def test_answers_wait_where_the_broker_acknowledges_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a broker; the last ones go out where the watch is stopped, and the end waits for them a little."""
    sent = MagicMock()
    monkeypatch.setattr("avtorch.live.mqtt._client", lambda address, name: sent)
    monkeypatch.setattr("avtorch.live.mqtt.CLOSE_S", 0.1)
    stop, answer = Event(), Answer({}, "red", 1, None)
    sink = MqttSink(MqttAddress.of("mqtt://localhost/answers"), stop)
    work = threading.Thread(target=lambda: [sink.write(answer) for _ in range(UNACKNOWLEDGED + 9)])
    work.start()
    until(lambda: sent.publish.call_count == UNACKNOWLEDGED)
    for _ in range(4):
        sent.on_publish(sent, None, 1, None, None)
    until(lambda: sent.publish.call_count == UNACKNOWLEDGED + 4)
    assert work.is_alive()
    stop.set()
    work.join(20)
    assert sent.publish.call_count == UNACKNOWLEDGED + 9
    sink.close()
    assert sent.disconnect.called


@pytest.mark.parametrize(
    "url",
    ["mqtt://", "mqtt:///topic", "mqtt://host:port/topic", "mqtt://host:70000/topic", "mqtt://host", "http://h/t"],
)
def test_addresses_that_are_none_are_refused(url: str) -> None:
    with pytest.raises(InputError, match=r"needs mqtt://HOST:PORT/TOPIC"):
        MqttAddress.of(url)


def test_an_address_does_not_tell_its_password() -> None:
    address = MqttAddress.of("mqtts://me:secret@broker.example/a/b#c")
    assert (address.user, address.password, address.port, address.topic) == ("me", "secret", 8883, "a/b#c")
    assert "secret" not in address.name
    for url in ("mqtt://me:secret@broker.example", "mqtt://me:se/secret@host/a", "mqtt://me:1/secret@host/a"):
        with pytest.raises(InputError) as fault:
            MqttAddress.of(url)
        assert "secret" not in str(fault.value)


def test_parts_of_an_address_may_hold_any_character() -> None:
    address = MqttAddress.of("mqtt://me:a%2Fb%40c@[::1]:1884/cars")
    assert (address.password, address.host, address.port, address.name) == (
        "a/b@c",
        "::1",
        1884,
        "mqtt://[::1]:1884/cars",
    )
    assert MqttAddress.of("mqtt://[::1]/cars").port == 1883
    assert MqttAddress.of("mqtt://host/cars@home").topic == "cars@home"
    assert MqttAddress.of("mqtt://@host:1884/cars@home").topic == "cars@home"
