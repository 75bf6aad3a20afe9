"""The server answers on this machine alone and behind its token alone; uploads are bounded and whole."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from avtorch.app import serve
from avtorch.app.workplace import Workplace
from avtorch.errors import InputError

# found, not imported: that takes seconds of every worker that only collects
pytestmark = pytest.mark.skipif(find_spec("panel") is None, reason="needs the extra app")


@pytest.fixture
def place(tmp_path: Path) -> Workplace:
    (tmp_path / "out" / "drive").mkdir(parents=True)
    (tmp_path / "out" / "drive" / "report.html").write_text("<p>a report</p>")
    (tmp_path / "out" / "drive" / "plant.toml").write_text("T_L = 0.3")
    (tmp_path / "drive.csv").write_text("time,speed\n")
    return Workplace.of(tmp_path)


@pytest.fixture
def port(place: Workplace) -> Iterator[int]:
    """A server of the routes beside the page, in a thread."""
    import asyncio

    from tornado.httpserver import HTTPServer
    from tornado.netutil import bind_sockets
    from tornado.web import Application

    (socket,) = bind_sockets(0, serve.ADDRESS)
    ended = asyncio.Event()
    loop = asyncio.new_event_loop()

    async def run() -> None:
        server = HTTPServer(Application(serve.handlers(place)))
        server.add_socket(socket)
        await ended.wait()
        server.stop()
        await server.close_all_connections()

    thread = threading.Thread(target=lambda: loop.run_until_complete(run()))
    thread.start()
    yield socket.getsockname()[1]
    loop.call_soon_threadsafe(ended.set)
    thread.join()
    loop.close()


def ask(port: int, method: str, path: str, body: bytes | None = None) -> tuple[int, str, dict[str, str]]:
    connection = http.client.HTTPConnection(serve.ADDRESS, port, timeout=20)
    connection.request(method, path, body)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text, dict(answer.getheaders())


def test_a_report_is_read_and_a_file_is_downloaded(port: int, place: Workplace) -> None:
    status, text, headers = ask(port, "GET", f"/{place.token}/files/out/drive/report.html")
    assert (status, text) == (200, "<p>a report</p>")
    assert headers["X-Content-Type-Options"] == "nosniff"
    _, _, headers = ask(port, "GET", f"/{place.token}/files/out/drive/plant.toml")
    assert headers["Content-Disposition"] == 'attachment; filename="plant.toml"'


@pytest.mark.parametrize(
    "path",
    [
        "/files/out/drive/report.html",
        "/wrong/files/out/drive/report.html",
        "/{token}/files/drive.csv",  # a log, no answer
        "/{token}/files/out/../drive.csv",
        "/{token}/files/out/drive/../../../etc/passwd",
        "/{token}/files//etc/passwd",
        "/{token}/files/out/drive",
        "/{token}/files/out/%2e%2e/drive.csv",
    ],
)
def test_nothing_else_is_served(port: int, place: Workplace, path: str) -> None:
    assert ask(port, "GET", path.format(token=place.token))[0] == 404


def test_an_upload_is_kept_under_out(port: int, place: Workplace) -> None:
    status, text, _ = ask(port, "PUT", f"/{place.token}/upload/..%2F..%2Fmy%20log.csv", b"time,speed\n0,1\n")
    assert (status, text) == (200, "out/logs/my log.csv")
    assert (place.root / text).read_bytes() == b"time,speed\n0,1\n"
    assert ask(port, "PUT", "/wrong/upload/log.csv", b"x")[0] == 404


def test_too_large_a_file_is_refused_before_it_is_read(
    port: int, place: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serve, "MOST_MB", 0)
    status, text, _ = ask(port, "PUT", f"/{place.token}/upload/log.csv", b"x")
    assert (status, text) == (413, "The file has over 0 MB; needs fewer")
    assert not (place.root / "out" / "logs").exists()


def test_half_an_upload_is_no_log(port: int, place: Workplace) -> None:
    import socket
    import time

    with socket.create_connection((serve.ADDRESS, port)) as half:
        half.sendall(
            f"PUT /{place.token}/upload/log.csv HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\nhalf".encode()
        )
        folder = place.root / "out" / "logs"
        for _ in range(100):
            if folder.exists() and list(folder.iterdir()):
                break
            time.sleep(0.05)
        assert [path.name for path in folder.iterdir()] == ["log.csv"]
    for _ in range(100):
        if not list(folder.iterdir()):
            break
        time.sleep(0.05)
    assert list(folder.iterdir()) == []


def test_tokens_are_long_and_differ(tmp_path: Path) -> None:
    tokens = {Workplace.of(tmp_path).token for _ in range(10)}
    assert len(tokens) == 10
    assert min(map(len, tokens)) >= 43  # 256 bits


# Bokeh leaves the socket that it could not bind to the collector
@pytest.mark.filterwarnings("ignore:Exception ignored in. <socket:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")
def test_it_listens_on_this_machine_alone(place: Workplace) -> None:
    server, address = serve.server_of(place)
    assert address == f"http://127.0.0.1:{server.port}/{place.token}"
    assert {s.getsockname()[0] for s in server._http._sockets.values()} == {"127.0.0.1"}
    with pytest.raises(InputError, match="cannot be used"):
        serve.server_of(place, server.port)
    server.stop()


def test_without_the_extra_one_line_says_what_to_install(place: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "panel.io.server", None)
    with pytest.raises(InputError, match=r"pip install 'avtorch\[app\]'"):
        serve.server_of(place)
