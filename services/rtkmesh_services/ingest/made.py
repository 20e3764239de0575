"""RTCM 3 that an ingest makes of its decoded stream for the outputs with ``encode``: they load no engine, this process has it."""

import struct
from dataclasses import dataclass

from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.rtcm3_base import BaseEncoder, BaseOptions
from rtkmesh.gnss.ephemeris import GlonassBias, ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh_schemas.config import OutputTable
from rtkmesh_schemas.keys import MADE
from rtkmesh_services.runtime.service import Context

ATTACHMENT = struct.Struct("<QqQ")  # sequence of the frame, UTC ns, monotonic ns of reading


@dataclass(slots=True)
class _Maker:
    encoder: BaseEncoder
    listened: bool = False
    frames: int = 0


class FrameMakers:
    """One encoder for each output that wants this receiver's stream as RTCM 3. Nothing is encoded while nobody listens."""

    def __init__(self, context: Context) -> None:
        self._bus, self._clock = context.bus, context.clock
        wanted = {name: table for name, table in context.deployment.output.items() if table.encode and context.id in _receivers(table)}
        self._makers = {name: _Maker(BaseEncoder(base_options(table))) for name, table in wanted.items()}

    def open(self) -> None:
        """Learn who listens."""
        for name in self._makers:
            self._bus.matched(MADE, output=name)

    def antenna(self, station: ReferenceStation, bias: GlonassBias | None) -> None:
        """Take where the antenna is."""
        for maker in self._makers.values():
            maker.encoder.take(station)
            if bias is not None:
                maker.encoder.take(bias)

    def take(self, message: Message, mono_ns: int) -> None:
        """Take a message of the stream; publish the frames that go out with it."""
        for name, maker in self._makers.items():
            if not isinstance(message, Epoch):
                maker.encoder.take(message)
            elif self._bus.matched(MADE, output=name):
                maker.listened = True
                self._publish(name, maker, maker.encoder.take(message), mono_ns)
            elif maker.listened:
                maker.listened = False
                maker.encoder.forget()

    def counters(self) -> dict[str, int]:
        """Return per output what was made, and how far epochs are thinned now."""
        rows = {name: {**maker.encoder.counters, "thinning_step": maker.encoder.step} for name, maker in self._makers.items()}
        return {f"made_{name}_{what}": count for name, counts in rows.items() for what, count in counts.items()}

    def _publish(self, name: str, maker: _Maker, frames: list[bytes], mono_ns: int) -> None:
        for frame in frames:
            self._bus.publish(MADE, frame, attachment=ATTACHMENT.pack(maker.frames, self._clock.utc_ns(), mono_ns), output=name)
            maker.frames += 1


def base_options(table: OutputTable) -> BaseOptions:
    """Return what a base sends by an output's table."""
    return BaseOptions(
        msm=int(table.encode[-1]),
        station_id=table.station_id,
        systems=table.systems,
        interval_s=table.interval_s,
        bytes_per_second=table.bytes_per_second,
        station_interval_s=table.station_interval_s,
        ephemeris_interval_s=table.ephemeris_interval_s,
    )


def _receivers(table: OutputTable) -> set[str]:
    return {table.receiver, *table.mounts.values()}
