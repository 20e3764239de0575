"""A telnet console of one solver: a listening thread and one thread per client, none of which control's loop waits for."""

import itertools
import socket
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

import rtkmesh
from rtkmesh_schemas.command import Reply
from rtkmesh_schemas.config_telnet import TelnetTable
from rtkmesh_schemas.keys import CONTROL_ID
from rtkmesh_schemas.status import Level
from rtkmesh_services.control.telnet.session import Desk, Session
from rtkmesh_services.control.telnet.throttle import Throttle
from rtkmesh_services.runtime.addresses import address_of
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.service import Context

ASK_S: Final = 2.0
CLOSE_S: Final = 2.0
_POLL_S: Final = 0.5
_FULL: Final = b"\r\ntoo many consoles: try again later\r\n"
_LOCKED: Final = b"\r\ntoo many wrong passwords: try again later\r\n"


class TelnetServer:
    """Serves ``[telnet.ID]``. OSError from ``__init__`` when the address cannot be listened on."""

    def __init__(self, id: str, table: TelnetTable, context: Context) -> None:  # noqa: A002  the word of the design
        self._id, self.table, self._context = id, table, context
        host, port = address_of(table.listen)
        self._listener = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET, backlog=16)
        self._listener.settimeout(_POLL_S)
        self.port: int = self._listener.getsockname()[1]
        self._lock = threading.Lock()
        self._throttle = Throttle()
        self._clients: dict[int, tuple[socket.socket, threading.Thread]] = {}
        self._numbers = itertools.count(1)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._listen, name=f"telnet-{id}", daemon=True)
        self.counters = {"logins": 0, "wrong_passwords": 0, "turned_away": 0}

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def close(self) -> None:
        """Let everybody go."""
        self._stopping.set()
        deadline_s = time.monotonic() + CLOSE_S
        self._thread.join(CLOSE_S)
        with self._lock:
            clients = list(self._clients.values())
        for connection, thread in clients:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            thread.join(max(deadline_s - time.monotonic(), 0.0))
        self._listener.close()

    @property
    def clients(self) -> int:
        """How many are connected."""
        return len(self._clients)

    def _listen(self) -> None:
        while not self._stopping.is_set():
            try:
                connection, address = self._listener.accept()
            except TimeoutError:
                continue
            except OSError as error:
                self._context.log.warning("telnet %s: %s", self._id, error)
                self._stopping.wait(_POLL_S)  # out of descriptors: others may let some go
                continue
            self._welcome(connection, str(address[0]))

    def _welcome(self, connection: socket.socket, address: str) -> None:
        with self._lock:
            locked = self._throttle.locked(address, time.monotonic())
            refusal = _LOCKED if locked else _FULL if len(self._clients) >= self.table.maximum_clients else b""
            if refusal:
                self.counters["turned_away"] += 1
                _turn_away(connection, refusal)
                return
            number = next(self._numbers)
            thread = threading.Thread(
                target=self._serve, args=(number, connection, address), name=f"telnet-{self._id}-{number}", daemon=True
            )
            self._clients[number] = (connection, thread)
        thread.start()

    def _serve(self, number: int, connection: socket.socket, address: str) -> None:
        begun_s = time.monotonic()
        try:
            why = Session(connection, self._desk(number, address)).run()
        except Exception as error:
            self._context.log.exception("telnet %s: a session failed", self._id)
            why = f"internal error: {type(error).__name__}"
        finally:
            connection.close()
            with self._lock:
                self._clients.pop(number, None)
        seconds = round(time.monotonic() - begun_s, 1)
        self._tell(Level.INFO, "telnet_left", f"{address} {why} after {seconds} s", address=address, reason=why, seconds=seconds)

    def _desk(self, number: int, address: str) -> Desk:
        caller = f"telnet {self._id} {address} #{number}"
        table = self.table
        if not table.password:
            self._came_in(address)
        return Desk(
            version=rtkmesh.__version__,
            password=table.password,
            idle_s=table.idle_s,
            allow_shutdown=table.allow_shutdown,
            ask=lambda op, args: self._ask(table.solver, op, args, caller),
            shut_down=lambda: self._ask(CONTROL_ID, "stop", {"id": table.solver}, caller),
            wrong=lambda: self._wrong(address),
            right=lambda: self._right(address),
            stopping=self._stopping,
        )

    def _ask(self, id_: str, op: str, args: Mapping[str, Any], caller: str) -> Reply:
        return call(self._context.bus, id_, op, args, ASK_S, caller=caller)[0]

    def _wrong(self, address: str) -> float:
        with self._lock:
            self.counters["wrong_passwords"] += 1
            pause_s = self._throttle.wrong(address, time.monotonic())
        self._tell(Level.WARNING, "telnet_refused", f"wrong password from {address}", address=address)
        return pause_s

    def _right(self, address: str) -> None:
        with self._lock:
            self._throttle.right(address)
        self._came_in(address)

    def _came_in(self, address: str) -> None:
        self.counters["logins"] += 1
        self._tell(Level.INFO, "telnet_login", f"{address} logged in", address=address)

    def _tell(self, level: Level, code: str, text: str, **data: Any) -> None:
        self._context.event(level, code, f"telnet {self._id}: {text}", console=self._id, **data)


def _turn_away(connection: socket.socket, text: bytes) -> None:
    """Say why, without waiting, and hang up."""
    with suppress(OSError), connection:
        connection.setblocking(False)
        connection.send(text)
