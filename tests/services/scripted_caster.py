"""A caster that does what a test's script says, on a real socket: a thread per connection, requests are kept."""

import socket
import ssl
import threading
from collections.abc import Callable
from contextlib import suppress

Script = Callable[[socket.socket, int], None]


class ScriptedCaster:
    """Takes connections, reads each one's request and lets the script answer (socket, number of the connection)."""

    def __init__(self, script: Script, *, tls: ssl.SSLContext | None = None) -> None:
        self.requests: list[bytes] = []
        self.closing = threading.Event()
        self._script, self._tls = script, tls
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._heard = threading.Condition()
        threading.Thread(target=self._accept, daemon=True).start()

    def request(self, number: int, timeout_s: float = 10.0) -> bytes:
        """Wait for a request and return it."""
        with self._heard:
            assert self._heard.wait_for(lambda: len(self.requests) > number, timeout_s), f"no request {number}"
            return self.requests[number]

    def close(self) -> None:
        """Take no more."""
        self.closing.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while not self.closing.is_set():
                connection, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with suppress(OSError):
            connection.settimeout(20.0)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._tls is not None:
                connection = self._tls.wrap_socket(connection, server_side=True)
            with connection:
                request = b""
                while not request.endswith(b"\r\n\r\n"):
                    data = connection.recv(4096)
                    if not data:
                        return
                    request += data
                with self._heard:
                    number = len(self.requests)
                    self.requests.append(request)
                    self._heard.notify_all()
                self._script(connection, number)


def chunked(pieces: list[bytes], extension: bytes = b"") -> bytes:
    """Return pieces as chunks, without the last one."""
    return b"".join(b"%x%b\r\n%b\r\n" % (len(piece), extension, piece) for piece in pieces)
