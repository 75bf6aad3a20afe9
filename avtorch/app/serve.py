"""The server of the workbench: on this machine alone, behind a token in the address."""

from __future__ import annotations

import logging
import mimetypes
from typing import Any

from avtorch.app.workplace import MOST_MB, Workplace
from avtorch.errors import InputError

ADDRESS = "127.0.0.1"


def handlers(place: Workplace) -> list[tuple[str, type]]:
    """Routes beside the page's own: answers to read and to download, and uploads."""
    from tornado.web import HTTPError, RequestHandler, stream_request_body

    class Route(RequestHandler):
        def set_default_headers(self) -> None:
            for name, value in (("Cache-Control", "no-store"), ("X-Content-Type-Options", "nosniff")):
                self.set_header(name, value)

        def write_error(self, status_code: int, **kwargs: Any) -> None:
            self.set_header("Content-Type", "text/plain; charset=utf-8")
            fault = kwargs.get("exc_info", (0, 0))[1]
            self.finish(getattr(fault, "log_message", "") or getattr(fault, "strerror", "") or self._reason)

    class Answer(Route):
        def get(self, name: str) -> None:
            try:
                path = place.inside(name)
            except InputError:
                raise HTTPError(404) from None
            if not (path.is_file() and place.name_of(path).startswith("out/")):
                raise HTTPError(404)
            kind = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
            self.set_header("Content-Type", f"{kind}; charset=utf-8" if kind.startswith("text/") else kind)
            if path.suffix != ".html":
                self.set_header("Content-Disposition", f'attachment; filename="{path.name}"')
            self.write(path.read_bytes())

    @stream_request_body
    class Upload(Route):
        """A log, written as it comes; what is too large is refused before it is read."""

        stream: Any = None

        def prepare(self) -> None:
            length = self.request.headers.get("Content-Length", "")
            if self.request.method != "PUT" or not length.isdecimal() or int(length) > MOST_MB * 2**20:
                raise HTTPError(413, f"The file has over {MOST_MB} MB; needs fewer")
            self.request.connection.set_max_body_size(MOST_MB * 2**20)  # pyright: ignore
            self.path_here = place.upload(self.path_args[0])
            self.stream = self.path_here.open("xb")

        def data_received(self, chunk: bytes) -> None:
            self.stream.write(chunk)

        def put(self, name: str) -> None:
            self.stream.close()
            self.stream = None
            self.write(place.name_of(self.path_here))

        def on_finish(self) -> None:
            if self.stream is not None:  # what did not come whole is no log
                self.stream.close()
                self.path_here.unlink(missing_ok=True)

        on_connection_close = on_finish

    return [(rf"/{place.token}/files/(.+)", Answer), (rf"/{place.token}/upload/(.+)", Upload)]


def server_of(place: Workplace, port: int = 0) -> tuple[Any, str]:
    """The server, not started, and the address of its page. `port` 0: a free one.

    Raises `InputError` where the port is taken, and without the extra `app`.
    """
    try:
        from panel.io.server import get_server
    except ImportError:
        raise InputError("avtorch app: needs Panel; pip install 'avtorch[app]'") from None
    from avtorch.app.page import page

    logging.getLogger("tornado.access").setLevel(logging.ERROR)  # what is not there is answered, not logged
    try:
        server = get_server(
            {place.token: lambda: page(place)},
            port=port,
            address=ADDRESS,
            websocket_origin=None if port == 0 else [f"{ADDRESS}:{port}"],
            title="avtorch workbench",
            redirect_root=False,
            use_index=False,
            extra_patterns=handlers(place),
            unused_session_lifetime_milliseconds=15_000,  # a tab that was closed ends its run soon
            check_unused_sessions_milliseconds=3_000,
        )
    except OSError as fault:
        raise InputError(f"--port: {port} cannot be used ({fault.strerror}); needs a free one, or none") from None
    return server, f"http://{ADDRESS}:{server.port}/{place.token}"
