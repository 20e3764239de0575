"""The whole way of a receiver's bytes: a live ingest as it is (framer, decoders, publisher) and those who read what it publishes.

Bytes come in pieces of any size that know nothing of frames, now and then damaged. Behind the ingest every message is decoded again, as
solvers do, and mapped to the engine's values; beside it a recorder's attachment is read.
"""

import random
from collections.abc import Iterator
from typing import Final

from tests.fuzz.frame_targets import START, mixed, streams
from tests.fuzz.harness import Reader, Target

from rtkmesh.codecs.messages import DecodingCounters, Protocol
from rtkmesh_schemas.config import Deployment, IngestTable
from rtkmesh_schemas.keys import EPH, IONO, OBS, RAW, REF, Role
from rtkmesh_schemas.observation import EphemerisMessage, IonosphereMessage, Observation, ReferenceMessage
from rtkmesh_schemas.wire import MAXIMUM_BYTES, Wire, decode, encode
from rtkmesh_services.ingest.links import Chunk
from rtkmesh_services.ingest.service import IngestService
from rtkmesh_services.mapping.navigation import ephemeris_of
from rtkmesh_services.mapping.observation import epoch_of
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context

_READ: Final = {OBS: Observation, EPH: EphemerisMessage, IONO: IonosphereMessage, REF: ReferenceMessage}
_DAMAGE: Final = 50  # of so many frames one is damaged on the line
_LONGEST_PIECE: Final = 1400
_STATUS_EVERY: Final = 500  # pieces


def pieces(seed: int) -> Iterator[bytes]:
    """Yield a stream of frames cut anywhere, some of them damaged."""
    rng, held = random.Random(seed), bytearray()
    for frame in mixed(seed):
        held += frame
        if rng.randrange(_DAMAGE) == 0:
            held[rng.randrange(len(held))] ^= 1 << rng.randrange(8)
        size = rng.randint(1, _LONGEST_PIECE)
        while len(held) >= size:
            yield bytes(held[:size])
            del held[:size]


class _World:
    """An ingest on a bus, and a reader of all that it says."""

    def __init__(self) -> None:
        self.network, self.clock = MemoryNetwork(), ManualClock(utc_ns=round(START.to_utc().timestamp()) * 10**9)
        table = IngestTable(source="tcp://127.0.0.1:1")
        bus = MemoryBus("rover", self.network)
        context = Context(id="rover", role=Role.INGEST, deployment=Deployment(ingest={"rover": table}), bus=bus, clock=self.clock)
        self.service = IngestService(context)
        self.service._start_source = lambda: None
        self.life = Lifecycle(self.service, warm_in_thread=False)
        for stream in (*_READ, RAW):
            key = stream.key("rover", **({"protocol": "*"} if stream is RAW else {"satellite": "*"} if stream is EPH else {}))
            self.network.subscribers.append((key, self._read))
        self.life.start()
        self.life.step(0.0)
        self.taken = 0

    def feed(self, data: bytes) -> None:
        self.clock.advance(0.001)
        self.service.handle(Chunk(data, self.clock.mono_ns()))
        self.network.sent.clear()
        self.taken += 1
        if self.taken % _STATUS_EVERY == 0:
            assert len(encode(self.life.status())) < MAXIMUM_BYTES

    def end(self) -> DecodingCounters | None:
        assert self.service._live is not None
        assert self.life.context.bus.counters["too_large"] == 0
        return None

    def _read(self, sample: Sample) -> None:
        stream = next((stream for stream in _READ if sample.key.split("/")[2] == stream.name), None)
        if stream is None:
            assert len(sample.attachment) == 24
            return
        message = decode(_READ[stream], sample.payload, sample.encoding)
        if isinstance(message, Observation):
            epoch_of(message)
        elif isinstance(message, EphemerisMessage):
            ephemeris_of(message)


def _reader() -> Reader:
    world = _World()
    return Reader(world.feed, world.end)


def published() -> Iterator[Wire]:
    """Yield messages that an ingest publishes of what simulated receivers send."""
    for protocol in (Protocol.UBX, Protocol.RTCM3):
        world = _World()
        world.service.handle(Chunk(streams()[protocol], 1))
        for sample in world.network.sent:
            stream = next((stream for stream in _READ if sample.key.split("/")[2] == stream.name), None)
            if stream is not None:
                yield decode(_READ[stream], sample.payload, sample.encoding)


def targets() -> list[Target]:
    """Return the target; its limit is that of a piece, which may end several frames and make a status."""
    return [Target("ingest", pieces, _reader, 0.1, limit_s=0.025)]  # 0.1 ms a frame; a piece may free a hundred that a false head held back
