"""Serves /metrics of both programs: few connections at once and none for long, whoever comes.

prometheus_client's own server gives each connection a thread for as long as it likes. Who opens enough of them and says
nothing takes the program's last file descriptors, without which a sidecar opens no further interface.
"""

from __future__ import annotations

import socket
import threading
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import make_wsgi_app

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

MAX_CONNECTIONS = 16
"""Scrapes at once; a further one is closed unheard."""
TIMEOUT_S = 5.0
"""For each read and write: a scraper over a slow network takes less."""
_STOP_TIMEOUT_S = 1.0


class _Handler(WSGIRequestHandler):
    timeout = TIMEOUT_S

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing."""


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True
    request_queue_size = MAX_CONNECTIONS

    def __init__(self, host: str, port: int) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._room = threading.BoundedSemaphore(MAX_CONNECTIONS)
        super().__init__((host, port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve it on a thread, if there is room."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve it."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that breaks or says nothing is none of the log's business."""


class MetricsServer:
    """Serves a registry on `host` (an address) from a thread of its own; raises OSError when it cannot listen."""

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        self._server = _Server(host, port)
        self._server.set_app(make_wsgi_app(registry))
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="plr-metrics", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port listened on, also where 0 was asked for."""
        return self._server.server_port

    def _serve(self) -> None:
        # Not serve_forever: that looks twice a second whether it should end, and keeps whoever ends it waiting.
        while not self._closing.is_set():
            self._server.handle_request()

    def close(self) -> None:
        """Stop serving."""
        self._closing.set()
        # Wakes the thread: on Linux, a socket that listens no more is readable.
        self._server.socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(_STOP_TIMEOUT_S)
        self._server.server_close()
