"""Outputs of receivers' whole frames, as they came or made anew."""

from typing import Any, ClassVar

from rtkmesh_schemas.config import OutputTable
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import MADE, RAW, REF, Role
from rtkmesh_schemas.observation import ReferenceMessage
from rtkmesh_schemas.wire import decode
from rtkmesh_services.ntrip.address import NTRIP_SCHEMES
from rtkmesh_services.ntrip.frames import StreamPicture, message_number
from rtkmesh_services.output.caster_sink import CasterSink
from rtkmesh_services.output.opening import open_caster, open_sink
from rtkmesh_services.output.sender import Header
from rtkmesh_services.output.targets import check_output
from rtkmesh_services.output.watch import Watch, drain
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.service import Context, Report, Service


class FrameOutputService(Service):
    """Sends receivers' frames to one target."""

    role: ClassVar[Role] = Role.OUTPUT

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: OutputTable = context.deployment.output[context.id]
        check_output(self._table)
        self._caster: CasterSink | None = None
        self._watch: Watch | None = None
        self._messages = frozenset(self._table.messages)
        self._frames = self._left_out = self._errors = 0

    def open(self) -> None:
        """Open the target and subscribe to the receivers."""
        table = self._table
        self._caster = open_caster(self.context, table)
        # What a station says of itself goes first to a caster: a client is of no use without it.
        preface = StreamPicture() if table.scheme in NTRIP_SCHEMES else Header(b"")
        self._watch = Watch(self.context, self._caster or open_sink(self.context, table, preface))
        self._watch.tick(self.context.clock.mono_ns())
        for receiver in {table.receiver, *table.mounts.values()} - {""}:
            self.context.subscribe(self._key(receiver), lane="raw")
            self.context.subscribe(REF.key(receiver), lane="ref", history=True)

    def handle(self, item: Any) -> None:
        """Pass a frame on."""
        if not isinstance(item, Sample) or self._watch is None:
            return
        _, receiver, kind, *_ = item.key.split("/")
        if kind == "ref":
            self._place(receiver, item)
            return
        self._frames += 1
        if self._messages and message_number(item.payload) not in self._messages:
            self._left_out += 1
        elif self._caster is not None:
            self._caster.feed(receiver, item.payload)
        else:
            self._watch.sink.send(item.payload)

    def tick(self, now_mono_ns: int) -> None:
        """Look after the target."""
        if self._watch is not None:
            self._watch.tick(now_mono_ns)

    def report(self) -> Report:
        """Tell the target, its clients and the frames."""
        counters = {"frames": self._frames, "frames_left_out": self._left_out, "errors": self._errors}
        if self._watch is None:
            return Report(counters=counters)
        return Report(state=self._watch.state, reason=self._watch.reason, inputs=self._watch.sink.statuses(), counters=counters)

    def close(self) -> None:
        """Send the rest and close the target."""
        drain(self.context, self.handle)
        if self._watch is not None:
            self._watch.close()

    def _place(self, receiver: str, item: Sample) -> None:
        """Tell our caster where a receiver's antenna is."""
        try:
            message = decode(ReferenceMessage, item.payload, item.encoding)
        except (DecodeError, VersionError):
            self._errors += 1
            return
        if self._caster is not None and message.position_ecef_m is not None:
            self._caster.place(receiver, message.position_ecef_m)

    def _key(self, receiver: str) -> str:
        """Return where a receiver's frames come from: as they came, or made for this output."""
        if self._table.encode:
            return MADE.key(receiver, output=self.context.id)
        return RAW.key(receiver, protocol="*" if self._table.protocol == "all" else self._table.protocol)
