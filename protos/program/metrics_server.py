"""Serves /metrics of both programs: few connections at once and none for long, whoever the client is.

prometheus_client's own server gives each connection a thread for as long as it likes. A client that opens enough of
them and says nothing takes the program's last file descriptors, and a sidecar can open no further interface.
"""

from __future__ import annotations

import logging
import socket
import threading
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import make_wsgi_app

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

log = logging.getLogger(__name__)

MAX_SCRAPES = 16
"""Scrapes at once; further connections are closed unread."""
TIMEOUT_S = 5.0
"""Limit for each read and write; a scraper over a slow network takes less."""
RETRY_S = 10.0
"""Interval between attempts to get a port that is taken."""
_STOP_TIMEOUT_S = 1.0


class _Handler(WSGIRequestHandler):
    timeout = TIMEOUT_S

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing."""


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True
    request_queue_size = MAX_SCRAPES

    def __init__(self, host: str, port: int) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._room = threading.BoundedSemaphore(MAX_SCRAPES)
        super().__init__((host, port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve the request on a thread, if there is room."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve the request."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a connection that breaks or says nothing; it is not worth a log line."""


class MetricsServer:
    """Serves a registry on `host` (an address) from its own thread.

    If the port is taken it warns once and retries every `retry_s`: any user of a host can take a port before a program
    starts, and that must not leave a robot without its sidecar.
    """

    def __init__(self, host: str, port: int, registry: CollectorRegistry, retry_s: float = RETRY_S) -> None:
        self._host = host
        self._port = port
        self._app = make_wsgi_app(registry)
        self._retry_s = retry_s
        self._server: _Server | None = None
        self._has_failed = False
        self._changing = threading.Lock()
        """Held while opening or closing: its thread may open while another one closes."""
        self._closing = threading.Event()
        self._open()
        self._thread = threading.Thread(target=self._serve, name="plr-metrics", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port listened on, even if 0 was requested; the requested one while that is taken."""
        server = self._server
        return self._port if server is None else server.server_port

    @property
    def is_listening(self) -> bool:
        """Whether the port could be opened."""
        return self._server is not None

    def _open(self) -> None:
        with self._changing:
            if self._closing.is_set():
                return
            try:
                server = _Server(self._host, self._port)
            except OSError as error:
                if not self._has_failed:
                    log.warning(
                        "metrics_listen: cannot listen on %s port %d: %s; no metrics until it can (retry: %.0f s)",
                        self._host, self._port, error.strerror or error, self._retry_s,
                    )  # fmt: skip
                self._has_failed = True
                return
            server.set_app(self._app)
            self._server = server
        if self._has_failed:
            log.info("metrics_listen: now listening on %s port %d", self._host, self._port)

    def _serve(self) -> None:
        # Not serve_forever: that checks only twice a second whether it should end, and keeps the caller waiting.
        while not self._closing.is_set():
            if self._server is not None:
                self._server.handle_request()
            elif not self._closing.wait(self._retry_s):
                self._open()

    def close(self) -> None:
        """Stop serving."""
        with self._changing:
            self._closing.set()
        if self._server is not None:
            # This wakes the thread: on Linux, a socket that no longer listens is readable.
            self._server.socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(_STOP_TIMEOUT_S)
        if self._server is not None:
            self._server.server_close()
