"""What takes the frames or texts of one output: one kind for each kind of target. None of them ever makes the work loop wait."""

from typing import Final, Protocol

from rtkmesh_schemas.config import OutputTable
from rtkmesh_schemas.keys import Stream
from rtkmesh_schemas.status import InputStatus
from rtkmesh_services.output.outlets import Opener, PushOpener, SerialOpener, StandardOutput, TcpOpener, UdpOpener
from rtkmesh_services.output.sender import Preface, Sender
from rtkmesh_services.output.server import Client, TcpServer
from rtkmesh_services.output.targets import TargetUrl
from rtkmesh_services.runtime.bus import Bus

SHOWN_CLIENTS: Final = 32  # a status is a small message


class Sink(Protocol):
    """Takes whole frames or texts."""

    @property
    def error(self) -> str:
        """What is wrong, in words, or nothing."""
        ...

    @property
    def dropped(self) -> int:
        """What never got there."""
        ...

    def send(self, data: bytes) -> None:
        """Take a frame or text; never blocks."""
        ...

    def tick(self) -> None:
        """Do what time asks for."""
        ...

    def statuses(self) -> list[InputStatus]:
        """Return where it goes."""
        ...

    def close(self) -> str:
        """Let go; return what could not be done, in words."""
        ...


class SenderSink:
    """To one taker, by a thread."""

    def __init__(self, opener: Opener, preface: Preface, maximum_age_s: float) -> None:
        self._sender = Sender(opener, preface, maximum_age_s)

    @property
    def error(self) -> str:
        """Why the taker takes nothing."""
        return self._sender.error

    @property
    def dropped(self) -> int:
        """What waited too long."""
        return self._sender.pump.dropped

    def send(self, data: bytes) -> None:
        """Queue it."""
        self._sender.send(data)

    def tick(self) -> None:
        """The thread does it."""

    def statuses(self) -> list[InputStatus]:
        """Return the taker."""
        sender, pump = self._sender, self._sender.pump
        return [
            InputStatus(
                name="target",
                state=sender.state,
                detail=sender.detail,
                messages=pump.sent,
                bytes=pump.bytes,
                dropped=pump.dropped,
                errors=sender.errors,
            )
        ]

    def close(self) -> str:
        """Let what waits go out, if it does so quickly."""
        self._sender.close()
        waiting = self._sender.pump.waiting
        return f"{waiting} bytes at the end were not sent" if waiting else ""


class ServerSink:
    """To all clients of a TCP server."""

    def __init__(self, url: TargetUrl, preface: Preface, maximum_clients: int, maximum_age_s: float) -> None:
        self._url = url
        self._server = TcpServer(url.host, url.port, preface, maximum_clients, maximum_age_s)
        self._sent = 0

    @property
    def error(self) -> str:
        """Why we cannot listen."""
        return self._server.error

    @property
    def dropped(self) -> int:
        """What clients were too slow for."""
        return self._server.dropped

    def send(self, data: bytes) -> None:
        """Queue it for each client."""
        self._sent += 1
        self._server.send(data)

    def tick(self) -> None:
        """The threads do it."""

    def statuses(self) -> list[InputStatus]:
        """Return the server, then each client."""
        clients = self._server.clients()
        detail = f"{self._url}, {len(clients)} client{'s' if len(clients) != 1 else ''}"
        state = "error" if self.error else "listening" if self._server.listening else "opening"
        server = InputStatus(
            name="server", state=state, detail=detail, messages=self._sent, dropped=self.dropped, errors=self._server.refused
        )
        return [server, *(self._row(client) for client in clients[:SHOWN_CLIENTS])]

    def close(self) -> str:
        """Serve nobody any more."""
        self._server.close()
        return ""

    def _row(self, client: Client) -> InputStatus:
        pump = client.pump
        return InputStatus(name=f"client {client.address}", state="served", messages=pump.sent, bytes=pump.bytes, dropped=pump.dropped)


class BusSink:
    """To a key of the network: a text stream of our own, or what an ingest writes to its receiver."""

    error, dropped = "", 0

    def __init__(self, bus: Bus, owner: str, stream: Stream, preface: Preface, *, attached: bool) -> None:
        self._bus, self._owner, self._stream = bus, owner, stream
        self._preface, self._attached = list(preface.station_frames()), attached
        self._sent = self._bytes = 0

    def send(self, data: bytes) -> None:
        """Publish it; the header goes along, or before the first one."""
        first = b"".join(self._preface)
        if self._attached:
            self._bus.publish_as(self._owner, self._stream, data, attachment=first or None)
        else:
            self._preface = []
            self._bus.publish_as(self._owner, self._stream, first + data)
        self._sent, self._bytes = self._sent + 1, self._bytes + len(data)

    def tick(self) -> None:
        """Nothing to do."""

    def statuses(self) -> list[InputStatus]:
        """Return the key."""
        return [InputStatus(name="key", state="open", detail=self._stream.key(self._owner), messages=self._sent, bytes=self._bytes)]

    def close(self) -> str:
        """The bus is the process's."""
        return ""


def sender_sink(url: TargetUrl, preface: Preface, table: OutputTable) -> Sink:
    """Return what takes the frames or texts of a target that is a socket, a port or standard output."""
    if url.scheme == "tcp-listen":
        return ServerSink(url, preface, table.maximum_clients, table.maximum_delay_s)
    return SenderSink(_opener(url), preface, table.maximum_delay_s)


def _opener(url: TargetUrl) -> Opener:
    if url.caster is not None:
        return PushOpener(url)
    if url.scheme == "stdout":
        return StandardOutput()
    return {"tcp": TcpOpener, "udp": UdpOpener, "serial": SerialOpener}[url.scheme](url)
