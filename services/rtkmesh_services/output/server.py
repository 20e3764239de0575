"""A TCP server of frames or texts: any number of clients, each with a thread and a queue of its own, so that none waits for another."""

import socket
import threading
from contextlib import suppress
from typing import Final

from rtkmesh_services.errors import SourceError
from rtkmesh_services.output.outlets import SocketOutlet
from rtkmesh_services.output.sender import CLOSE_S, POLL_S, Preface, Pump

RETRY_S: Final = 1.0  # after which a port that was taken is tried again


class Client:
    """One client that is being served, until it closes or takes nothing."""

    def __init__(self, connection: socket.socket, address: str, preface: Preface, maximum_age_s: float) -> None:
        self.address, self.pump = address, Pump(preface, maximum_age_s)
        self._outlet = SocketOutlet(connection, address)
        self.thread = threading.Thread(target=self._run, daemon=True, name=f"client {address}")
        self.thread.start()

    def close(self, wait_s: float) -> None:
        """End; what waits has a little time to leave."""
        self.pump.stop()
        self.thread.join(wait_s)
        if self.thread.is_alive():
            self._outlet.close()

    def _run(self) -> None:
        with suppress(SourceError, OSError):
            self.pump.run(self._outlet)
        self._outlet.close()


class TcpServer:
    """Listens, and serves who connects. ``error``: why it cannot listen."""

    def __init__(self, host: str, port: int, preface: Preface, maximum_clients: int, maximum_age_s: float) -> None:
        self._address, self._preface = (host, port), preface
        self._maximum_clients, self._maximum_age_s = maximum_clients, maximum_age_s
        self._lock = threading.Lock()
        self._clients: list[Client] = []
        self._gone = 0  # dropped for clients that are not there any more
        self._stopping = threading.Event()
        self.error = ""
        self.listening = False
        self.refused = 0
        self._thread = threading.Thread(target=self._run, daemon=True, name="server")
        self._thread.start()

    @property
    def dropped(self) -> int:
        """What clients were too slow for."""
        return self._gone + sum(client.pump.dropped for client in self.clients())

    def clients(self) -> list[Client]:
        """Return who is served now."""
        with self._lock:
            ended = [client for client in self._clients if not client.thread.is_alive()]
            self._gone += sum(client.pump.dropped for client in ended)
            self._clients = [client for client in self._clients if client not in ended]
            return list(self._clients)

    def send(self, data: bytes) -> None:
        """Take a frame or text for all clients; never blocks."""
        for client in self.clients():
            client.pump.put(data)

    def close(self) -> None:
        """Listen no more; what waits has a little time to leave."""
        self._stopping.set()
        clients = self.clients()
        for client in clients:
            client.pump.stop()
        for client in clients:
            client.close(CLOSE_S / len(clients))
        self._thread.join(POLL_S)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                family = socket.AF_INET6 if ":" in self._address[0] else socket.AF_INET
                with socket.create_server(self._address, family=family) as listener:
                    self.error, self.listening = "", True
                    self._accept(listener)
            except OSError as error:
                self.listening = False
                self.error = f"tcp-listen://{self._address[0]}:{self._address[1]}: {error.strerror or error}"
                self._stopping.wait(RETRY_S)

    def _accept(self, listener: socket.socket) -> None:
        listener.settimeout(POLL_S)
        while not self._stopping.is_set():
            try:
                connection, address = listener.accept()
            except TimeoutError:
                continue
            if len(self.clients()) >= self._maximum_clients:
                self.refused += 1
                connection.close()
                continue
            with suppress(OSError), self._lock:  # one that has gone again
                self._clients.append(Client(connection, f"{address[0]}:{address[1]}", self._preface, self._maximum_age_s))
