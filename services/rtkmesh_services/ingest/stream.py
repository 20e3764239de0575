"""What an ingest publishes: its stream's messages, numbered in stream order, and the raw frames."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from rtkmesh.codecs.framing import FRAMED
from rtkmesh.codecs.messages import Frame, Message
from rtkmesh.gnss.ephemeris import GlonassBias, GlonassEphemeris, KeplerEphemeris, KlobucharParameters, ReferenceStation
from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.receiver import ReceiverHeading
from rtkmesh.gnss.signals import satellite_id
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.keys import END, EPH, HEADING, IONO, OBS, RAW, REF
from rtkmesh_schemas.observation import EndOfStream, EphemerisMessage, IonosphereMessage, ReferenceMessage
from rtkmesh_services.ingest.made import ATTACHMENT, FrameMakers
from rtkmesh_services.mapping.heading import heading_message
from rtkmesh_services.mapping.navigation import orbit_of, wire_time
from rtkmesh_services.mapping.observation import observation_of
from rtkmesh_services.runtime.service import Context

Position = tuple[float, float, float]


def is_numbered(message: Message) -> bool:
    """Return whether a message is part of the numbered stream (all but the receiver's own fixes)."""
    return isinstance(message, Epoch | KeplerEphemeris | GlonassEphemeris | KlobucharParameters | ReferenceStation | GlonassBias)


def all_slipped(epoch: Epoch) -> Epoch:
    """Return an epoch before which nobody watched the phases."""
    return replace(epoch, flags=np.where(np.isfinite(epoch.phase_cyc), epoch.flags | SLIP, epoch.flags).astype(np.uint8))


class StreamPublisher:
    """Publishes the messages of one receiver in stream order. ``known`` replaces the position that the stream says."""

    def __init__(self, context: Context, known: Position | None, *, raw: bool) -> None:
        self._context, self._bus = context, context.bus
        self._known, self._raw = known, raw
        self._origin, self._datum = "configuration", ""  # of what is known
        self._frames = self._headings = 0
        self.sequence = 0
        self.published: Counter[str] = Counter()
        self.newest: Epoch | None = None
        self._station = ReferenceStation(station_id=0, position_ecef_m=known, source="configuration" if known else "")
        self._bias: GlonassBias | None = None
        self._slipped = False
        self.made = FrameMakers(context)

    def open(self) -> None:
        """Publish what is known before the first byte: a configured antenna position. Learn who listens to raw frames."""
        if self._raw:
            for protocol in FRAMED:
                self._bus.matched(RAW, protocol=protocol.value)
        self.made.open()
        if self._known is not None:
            self._reference()

    def frame(self, frame: Frame, mono_ns: int) -> None:
        """Publish a raw frame when somebody listens."""
        if self._raw and self._bus.matched(RAW, protocol=frame.protocol.value):
            attachment = ATTACHMENT.pack(self._frames, self._context.clock.utc_ns(), mono_ns)
            self._bus.publish(RAW, frame.data, attachment=attachment, protocol=frame.protocol.value)
        self._frames += 1

    def message(self, message: Message, mono_ns: int) -> None:
        """Publish one decoded message."""
        if isinstance(message, Epoch):
            self._epoch(message, mono_ns)
        elif isinstance(message, KeplerEphemeris | GlonassEphemeris):
            name = satellite_id(message.satellite)
            self._bus.publish(EPH, EphemerisMessage(orbit=orbit_of(message), **self._next("eph")), satellite=name)
            self.made.take(message, mono_ns)
        elif isinstance(message, KlobucharParameters):
            parameters = {"system": message.system, "alpha": message.alpha, "beta": message.beta}
            self._bus.publish(IONO, IonosphereMessage(**parameters, **self._next("iono")))
        elif isinstance(message, ReferenceStation):
            self._stand(message)
        elif isinstance(message, GlonassBias):
            self._bias = message
            self._reference()

    def heading(self, heading: ReceiverHeading, mono_ns: int) -> None:
        """Publish a heading that the receiver computed: numbered for itself, no part of the stream."""
        identity = {"source": self._context.id, "start_id": self._context.start_id, "sequence": self._headings}
        self._headings += 1
        self._bus.publish(HEADING, heading_message(heading, received_mono_ns=mono_ns, **identity))

    def stand_at(self, position: Position, origin: str, datum: str) -> None:
        """Publish a position that was found or told: in place of what the stream says, that of a survey until the stream says one."""
        if origin != "survey-in":
            self._known, self._origin, self._datum = position, origin, datum
        self._station = replace(self._station, position_ecef_m=position, source=origin)
        self._reference()

    def switch(self, station: ReferenceStation | None, bias: GlonassBias | None) -> None:
        """Go on with another source: its antenna (None: nobody knows yet) instead of the last one's, and new phases."""
        self._bias, self._slipped = bias, True
        self._stand(station or ReferenceStation(station_id=0))

    def end(self) -> None:
        """Publish that a replayed source is at its end."""
        self._bus.publish(END, EndOfStream(**self._next("end")))

    def _epoch(self, epoch: Epoch, mono_ns: int) -> None:
        if self._slipped:
            self._slipped, epoch = False, all_slipped(epoch)
        utc_ns = self._context.clock.utc_ns()
        self._bus.publish(OBS, observation_of(epoch, mono_ns=mono_ns, utc_ns=utc_ns, **self._number("obs")))
        if self.newest is None or epoch.time > self.newest.time:
            self.newest = epoch
        self.made.take(epoch, mono_ns)

    def _stand(self, station: ReferenceStation) -> None:
        known = self._known is not None
        self._station = replace(station, position_ecef_m=self._known, source=self._origin) if known else station
        self._reference()

    def _reference(self) -> None:
        station = self._station
        message = ReferenceMessage(
            station_id=station.station_id,
            position_ecef_m=station.position_ecef_m,
            antenna_height_m=station.antenna_height_m,
            antenna=station.antenna,
            antenna_serial=station.antenna_serial,
            receiver=station.receiver,
            datum=self._datum if station.source == self._origin else "",
            origin=station.source,
            glonass_bias_m=None if self._bias is None else self._bias.bias_m,
            **self._next("ref"),
        )
        self._bus.publish(REF, message)
        self.made.antenna(station, self._bias)

    def _next(self, kind: str) -> dict[str, Any]:
        """Return the identity of the next message between epochs: its number, and the epoch that it follows."""
        after: GpsTime | None = None if self.newest is None else self.newest.time
        return {**self._number(kind), "after": wire_time(after)}

    def _number(self, kind: str) -> dict[str, Any]:
        """Return the identity of the next numbered message."""
        identity = {"source": self._context.id, "start_id": self._context.start_id, "sequence": self.sequence}
        self.sequence += 1
        self.published[kind] += 1
        return identity
