"""Outputs of receivers' whole frames, as they came or made anew: to files and sockets, to a caster, to the clients of our own caster."""

from math import atan2, degrees, hypot
from typing import Any, ClassVar, Final, Protocol

from rtkmesh_schemas.config import OutputTable
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import MADE, RAW, REF, Role
from rtkmesh_schemas.observation import ReferenceMessage
from rtkmesh_schemas.status import InputStatus, Level, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.ntrip.caster import Caster
from rtkmesh_services.ntrip.frames import message_number
from rtkmesh_services.ntrip.source_table import MountPoint
from rtkmesh_services.output.push import Push
from rtkmesh_services.output.targets import CASTER_SCHEME, Target, TargetUrl, check_output, open_target, parse_target
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.service import Context, Report, Service

RETRY_NS: Final = 1_000_000_000
SHOWN_CLIENTS: Final = 32  # a status is a small message
_FLATTENING: Final = 0.00669438  # first eccentricity squared of WGS 84: the table says hundredths of a degree


class FrameSink(Protocol):
    """Takes whole frames."""

    @property
    def error(self) -> str:
        """What is wrong, in words, or nothing."""
        ...

    def send(self, receiver: str, frame: bytes) -> None:
        """Take a frame of a receiver; never blocks."""
        ...

    def reference(self, receiver: str, message: ReferenceMessage) -> None:
        """Take where a receiver's antenna is."""
        ...

    def tick(self, now_mono_ns: int) -> None:
        """Do what time asks for."""
        ...

    def statuses(self) -> list[InputStatus]:
        """Return where frames go."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


class PlainSink:
    """Frames to a file, a socket or the clients of a TCP server, one behind the other."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._target: Target | None = None
        self._tried_ns = -RETRY_NS
        self._sent = self._lost = 0
        self.error = ""

    def send(self, receiver: str, frame: bytes) -> None:
        """Send a frame, or count it as lost."""
        del receiver
        try:
            if self._target is None:
                raise ConnectionError(self.error or "the target is not open")
            self._target.send(b"", frame)
            self._sent, self.error = self._sent + 1, ""
        except OSError as error:
            self._lost, self.error = self._lost + 1, str(error)

    def reference(self, receiver: str, message: ReferenceMessage) -> None:
        """Nobody asks for it here."""

    def tick(self, now_mono_ns: int) -> None:
        """Let the target flush and reconnect; open it when it is not."""
        try:
            if self._target is not None:
                self._target.tick()
            elif now_mono_ns - self._tried_ns >= RETRY_NS:
                self._tried_ns = now_mono_ns
                self._target = open_target(self._url)
                self.error = ""
        except OSError as error:
            self.error = f"{parse_target(self._url)}: {error.strerror or error}"

    def statuses(self) -> list[InputStatus]:
        """Return the target."""
        detail = str(parse_target(self._url)) if self._target is None else self._target.detail
        state = "error" if self.error else "open"
        return [InputStatus(name="target", state=state, detail=detail, messages=self._sent, dropped=self._lost)]

    def close(self) -> None:
        """Close the target."""
        if self._target is not None:
            self._target.close()


class PushSink:
    """Frames to a caster's mount point."""

    def __init__(self, url: TargetUrl) -> None:
        self._push = Push(url)

    @property
    def error(self) -> str:
        """Why the caster does not take them."""
        return self._push.detail if self._push.state == "error" else ""

    def send(self, receiver: str, frame: bytes) -> None:
        """Queue a frame."""
        del receiver
        self._push.send(frame)

    def reference(self, receiver: str, message: ReferenceMessage) -> None:
        """The frames say it."""

    def tick(self, now_mono_ns: int) -> None:
        """The thread does it."""

    def statuses(self) -> list[InputStatus]:
        """Return the mount point."""
        push = self._push
        return [
            InputStatus(name="ntrip", state=push.state, detail=push.detail, messages=push.sent, dropped=push.dropped, errors=push.errors)
        ]

    def close(self) -> None:
        """Stop."""
        self._push.close()


class CasterSink:
    """Frames to the clients of our own caster. A receiver may be at several mount points."""

    def __init__(self, url: TargetUrl, table: OutputTable) -> None:
        self._url, self._table = url, table
        self._caster: Caster | None = None
        self._places: dict[str, MountPoint] = {name: MountPoint(name, receiver) for name, receiver in table.mounts.items()}
        self._tried_ns = -RETRY_NS
        self._frames = 0
        self.error = ""

    def send(self, receiver: str, frame: bytes) -> None:
        """Hand a frame to the caster's thread."""
        self._frames += 1
        for mount, feeder in self._table.mounts.items():
            if feeder == receiver and self._caster is not None:
                self._caster.publish(mount, frame)

    def reference(self, receiver: str, message: ReferenceMessage) -> None:
        """Tell the place in the source table."""
        if message.position_ecef_m is None:
            return
        lat_deg, lon_deg = rough_place(message.position_ecef_m)
        for mount, feeder in self._table.mounts.items():
            if feeder == receiver:
                self._places[mount] = MountPoint(mount, receiver, lat_deg=lat_deg, lon_deg=lon_deg)
                if self._caster is not None:
                    self._caster.describe(self._places[mount])

    def tick(self, now_mono_ns: int) -> None:
        """Listen when we do not yet."""
        if self._caster is not None or now_mono_ns - self._tried_ns < RETRY_NS:
            return
        self._tried_ns = now_mono_ns
        try:
            self._caster = Caster(self._url.host, self._url.port, self._places, self._table.users, self._table.maximum_clients)
            self._caster.start()
            self.error = ""
        except OSError as error:
            self.error = f"{self._url}: {error.strerror or error}"

    def statuses(self) -> list[InputStatus]:
        """Return the caster, then each client."""
        if self._caster is None:
            return [InputStatus(name="caster", state="error", detail=self.error)]
        clients = self._caster.clients()
        detail = f"{self._url}, {len(clients)} client{'s' if len(clients) != 1 else ''}"
        dropped, refused = self._caster.dropped, self._caster.refused
        caster = InputStatus(name="caster", state="listening", detail=detail, messages=self._frames, dropped=dropped, errors=refused)
        rows = [
            InputStatus(
                name=f"client {client.address}",
                state="served",
                detail=f"{client.mount}, version {client.version}, {client.user or 'anonymous'}, {client.agent}",
                bytes=client.bytes,
                dropped=client.dropped,
            )
            for client in clients[:SHOWN_CLIENTS]
        ]
        return [caster, *rows]

    def close(self) -> None:
        """Serve nobody any more."""
        if self._caster is not None:
            self._caster.close()


class FrameOutputService(Service):
    """Sends receivers' frames to one target."""

    role: ClassVar[Role] = Role.OUTPUT

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: OutputTable = context.deployment.output[context.id]
        check_output(self._table)
        self._sink: FrameSink | None = None
        self._messages = frozenset(self._table.messages)
        self._error = ""
        self._frames = self._left_out = self._errors = 0

    def open(self) -> None:
        """Open the target and subscribe to the receivers."""
        self._sink = sink_of(self._table)
        self._sink.tick(self.context.clock.mono_ns())
        for receiver in {self._table.receiver, *self._table.mounts.values()} - {""}:
            self.context.subscribe(self._key(receiver), lane="raw")
            self.context.subscribe(REF.key(receiver), lane="ref", history=True)

    def handle(self, item: Any) -> None:
        """Pass a frame on."""
        if not isinstance(item, Sample) or self._sink is None:
            return
        _, receiver, kind, *_ = item.key.split("/")
        if kind in ("raw", "made"):
            self._frames += 1
            if self._messages and message_number(item.payload) not in self._messages:
                self._left_out += 1
            else:
                self._sink.send(receiver, item.payload)
            return
        try:
            self._sink.reference(receiver, decode(ReferenceMessage, item.payload, item.encoding))
        except (DecodeError, VersionError):
            self._errors += 1

    def tick(self, now_mono_ns: int) -> None:
        """Let the target do its things; tell what is wrong with it once."""
        if self._sink is None:
            return
        self._sink.tick(now_mono_ns)
        error = self._sink.error
        if error and error != self._error:
            self.context.event(Level.WARNING, "output_failed", error, logged=bool(self._error))
        self._error = error

    def report(self) -> Report:
        """Tell the target, its clients and the frames."""
        state = State.DEGRADED if self._error else State.RUNNING
        inputs = [] if self._sink is None else self._sink.statuses()
        counters = {"frames": self._frames, "frames_left_out": self._left_out, "errors": self._errors}
        return Report(state=state, reason=self._error, inputs=inputs, counters=counters)

    def close(self) -> None:
        """Close the target."""
        if self._sink is not None:
            self._sink.close()

    def _key(self, receiver: str) -> str:
        """Return where a receiver's frames come from: as they came, or made for this output."""
        if self._table.encode:
            return MADE.key(receiver, output=self.context.id)
        return RAW.key(receiver, protocol="*" if self._table.protocol == "all" else self._table.protocol)


def sink_of(table: OutputTable) -> FrameSink:
    """Return what takes the frames of a table; SourceError for a wrong target."""
    url = parse_target(table.target)
    if url.scheme == CASTER_SCHEME:
        return CasterSink(url, table)
    return PushSink(url) if url.caster is not None else PlainSink(table.target)


def rough_place(position_ecef_m: tuple[float, float, float]) -> tuple[float, float]:
    """Return latitude and longitude in degrees of a place near the ground, good to a thousandth of a degree."""
    x, y, z = position_ecef_m
    return degrees(atan2(z, hypot(x, y) * (1.0 - _FLATTENING))), degrees(atan2(y, x))
