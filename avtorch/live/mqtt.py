"""MQTT: rows from a topic, answers to a topic, by paho-mqtt.

The source turns the client's loop itself, message by message: while the estimate is behind, the socket is not read, and
the broker holds what it is asked to hold. The sink waits where too many of its answers are not yet acknowledged.
"""

from __future__ import annotations

import contextlib
import importlib.util
import ssl
import threading
import time
from collections.abc import Generator
from dataclasses import dataclass
from threading import Event
from typing import Any
from urllib.parse import unquote, urlsplit

from avtorch.errors import InputError, printable, quoted
from avtorch.live.car import Answer
from avtorch.live.source import Batch, LineParser, Row
from avtorch.live.watch_source import line_of

INSTALL = "pip install 'avtorch[live]'"
MESSAGES = 500
"""Messages of a batch at most."""
UNACKNOWLEDGED = 200
"""Answers on their way to the broker at most."""
RECONNECT_S = 1.0
CLOSE_S = 5.0
"""Time that the last answers have to reach the broker [s]."""
_KEEPALIVE_S = 60
_WAIT_S = 0.2
_NEED = "needs mqtt://HOST:PORT/TOPIC"


@dataclass(frozen=True)
class MqttAddress:
    """A broker and a topic, from `mqtt://[USER:PASSWORD@]HOST[:PORT]/TOPIC`; `mqtts` for TLS."""

    host: str
    port: int
    topic: str
    tls: bool = False
    user: str | None = None
    password: str | None = None

    @staticmethod
    def of(url: str) -> MqttAddress:
        """Raises `InputError` for what is no such URL; its password is not told.

        User and password may hold any character as `%` and two hexadecimal digits, and must so hold `/`, `@` and `:`.
        """
        scheme, _, rest = url.partition("://")
        authority, _, topic = rest.partition("/")
        # a password with a slash of its own would else be told as host and topic
        shown = quoted(f"{scheme}://{rest.rpartition('@')[2]}", 80)
        try:
            found = urlsplit(f"//{authority}")
            port = found.port or (8883 if scheme == "mqtts" else 1883)
        except ValueError:
            raise InputError(f"MQTT: found {shown}, {_NEED}") from None
        if scheme not in ("mqtt", "mqtts") or not found.hostname:
            raise InputError(f"MQTT: found {shown}, {_NEED}")
        if "@" in topic and "@" not in authority and ":" in authority:
            need = "in a password / is %2F; where there is none, needs @ before the host"
            raise InputError(f"MQTT: found @ behind the first /, before {shown}; {need}")
        if not topic or "\0" in topic or len(topic.encode()) > 65535:
            raise InputError(f"MQTT: found {shown}, without a topic; {_NEED}")
        user, password = (unquote(part or "") or None for part in (found.username, found.password))
        return MqttAddress(found.hostname, port, topic, scheme == "mqtts", user, password)

    @property
    def name(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'mqtts' if self.tls else 'mqtt'}://{host}:{self.port}/{self.topic}"


def is_mqtt(text: str) -> bool:
    """Whether `text` is an MQTT address, and no path."""
    return text.startswith(("mqtt://", "mqtts://"))


def _client(address: MqttAddress, client_id: str | None) -> Any:
    if importlib.util.find_spec("paho") is None:
        raise InputError(f"MQTT needs paho-mqtt, which is not installed: {INSTALL}")
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    client = Client(CallbackAPIVersion.VERSION2, client_id=client_id or "", clean_session=client_id is None)
    if address.user is not None:
        client.username_pw_set(address.user, address.password)
    if address.tls:
        client.tls_set_context(ssl.create_default_context())
    return client


def _connect(client: Any, address: MqttAddress) -> None:
    try:
        client.connect(address.host, address.port, keepalive=_KEEPALIVE_S)
    except (OSError, ValueError) as fault:
        why = printable(str(fault) or type(fault).__name__, 120)
        raise InputError(f"{address.name}: the broker cannot be reached ({why})") from None


class MqttSource:
    """Rows from a topic, which may hold the wildcards + and #; a message is one row in JSON, a list, or one a line.

    A row without `car` is of the car named as its topic. With a `client_id` the broker keeps messages while the watch
    is not connected. Raises `InputError` where paho-mqtt is missing, and from `batches` for a broker that cannot be
    reached at the start or that refuses.
    """

    identity = None

    def __init__(self, address: MqttAddress, parser: LineParser, *, client_id: str | None = None) -> None:
        self.address, self.parser = address, parser
        self._rows: list[Row] = []
        self._refused: str | None = None
        self._client = _client(address, client_id)
        self._client.on_connect = self._on_connect
        self._client.on_subscribe = self._on_subscribe
        self._client.on_message = self._on_message

    def batches(self, stop: Event, start: int | None = None) -> Generator[Batch, None, None]:
        """As the contract; a broker has no positions, so `start` has no meaning."""
        _connect(self._client, self.address)
        try:
            while not stop.is_set():
                fault = self._client.loop(_WAIT_S)
                for _ in range(MESSAGES):
                    had = len(self._rows)
                    if fault or not had or self._client.loop(0.0) or len(self._rows) == had:
                        break
                if self._refused is not None:
                    raise InputError(f"{self.address.name}: the broker refuses ({self._refused})")
                rows, self._rows = self._rows, []
                yield Batch(rows)
                if fault:
                    self._again()
        finally:
            self._client.disconnect()
            with contextlib.suppress(OSError):
                self._client.loop(0.0)

    def _again(self) -> None:
        time.sleep(RECONNECT_S)
        with contextlib.suppress(OSError, ValueError):  # tried again a second later
            self._client.reconnect()

    def _on_connect(self, client: Any, userdata: Any, flags: Any, code: Any, properties: Any) -> None:
        if code.is_failure:
            self._refused = printable(str(code), 80)
            return
        client.subscribe(self.address.topic, qos=1)

    def _on_subscribe(self, client: Any, userdata: Any, mid: int, codes: Any, properties: Any) -> None:
        if any(code.is_failure for code in codes):
            self._refused = printable(f"{codes[0]}", 80)

    def _on_message(self, client: Any, userdata: Any, message: Any) -> None:
        try:
            topic = message.topic
        except UnicodeDecodeError:
            self.parser.counts.refuse("corrupt")
            return
        self._rows += self.parser.message(message.payload, car=topic)


class MqttSink:
    """Answers to a topic, one message each, at least once (QoS 1).

    Raises `InputError` where paho-mqtt is missing, the broker cannot be reached, or the topic has wildcards.
    """

    def __init__(self, address: MqttAddress, stop: Event | None = None) -> None:
        if any(mark in address.topic for mark in "+#"):
            raise InputError(f"{address.name}: answers need one topic, without + and #")
        self.address, self._stop = address, Event() if stop is None else stop
        self._free = threading.Semaphore(UNACKNOWLEDGED)
        self._client = _client(address, None)
        self._client.on_publish = lambda *_: self._free.release()
        _connect(self._client, address)
        self._client.loop_start()

    def write(self, answer: Answer) -> bool:
        """Send; waits while too many answers are on their way, until the watch is stopped."""
        while not self._free.acquire(blocking=False) and not self._stop.wait(_WAIT_S):
            pass
        self._client.publish(self.address.topic, line_of(answer).strip(), qos=1)
        return True

    def flush(self) -> None:
        """Nothing: the client sends by itself."""

    def close(self) -> None:
        """Wait a little for the last answers to be acknowledged, then disconnect."""
        end = time.monotonic() + CLOSE_S
        for _ in range(UNACKNOWLEDGED):
            self._free.acquire(timeout=max(0.0, end - time.monotonic()))
        self._client.disconnect()
        self._client.loop_stop()
