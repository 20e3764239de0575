"""The ingest role: one receiver's bytes in, checked frames, epochs, ephemerides and reference position out."""

import threading
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from rtkmesh.codecs.messages import Frame, Message
from rtkmesh.codecs.rtcm3_encode import encode_epoch
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.codecs.ubx_encode import encode_rawx
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.epoch import make_epoch
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.command import Reply, Request
from rtkmesh_schemas.config import IngestTable
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import CREDIT, WRITE, Role
from rtkmesh_schemas.observation import Credit
from rtkmesh_schemas.status import InputStatus, Level, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.credit import CreditGate
from rtkmesh_services.ingest.links import Chunk, Link, LinkReport, LinkState
from rtkmesh_services.ingest.recording import RawRecording, Recording
from rtkmesh_services.ingest.replay import Ended, Pace, Played, Replay, Simulation, common_start, date_of, gps_now, recording_of
from rtkmesh_services.ingest.stream import StreamPublisher
from rtkmesh_services.ingest.urls import SourceUrl, parse_source
from rtkmesh_services.mapping.position import known_position
from rtkmesh_services.runtime.bus import Liveliness, Sample
from rtkmesh_services.runtime.service import Context, Report, Service, accepted, done
from rtkmesh_services.runtime.statistics import RollingQuantiles

DEAD_CONSUMER_S = 10.0  # how long a replay as fast as it goes waits for a consumer that died
STALE_S = 5.0  # a live source that is silent for so long is STALE


class IngestService(Service):
    """One receiver. All decoding and publishing happens in the work loop; links and replays have threads of their own."""

    role: ClassVar[Role] = Role.INGEST
    operations: ClassVar[Mapping[str, str]] = {"restart": "close the source and open it again"}

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: IngestTable = context.deployment.ingest[context.id]
        self._url: SourceUrl = parse_source(self._table.source)
        self._decoder = StreamDecoder(self._options())
        self._publisher = StreamPublisher(context, known_position(self._table), raw=self._table.raw)
        self._gate = CreditGate(consumers_of(context), patience_s=0.0 if self._url.scheme != "file" or self._url.speed else DEAD_CONSUMER_S)
        self._decode_ms = RollingQuantiles()
        self._link: Link | None = None
        self._recording: Recording | None = None
        self._stop_source = threading.Event()
        self._state, self._detail = LinkState.CONNECTING, ""
        self._bytes = self._errors = self._writes = self._writes_lost = 0
        self._heard_ns = context.clock.mono_ns()

    def warm(self) -> None:
        """Compile the decoders."""
        warm_decoder()

    def open(self) -> None:
        """Listen for credit and writes, publish the known position, start the source."""
        self.context.subscribe(CREDIT.key(self.context.id), lane="credit")
        self.context.subscribe(WRITE.key(self.context.id), lane="write")
        self.context.bus.on_live(self._on_live)
        self._publisher.open()
        self._start_source()

    def handle(self, item: Any) -> None:
        """Take bytes, a replayed message, a change of the link, credit or a frame to write."""
        if isinstance(item, Chunk):
            self._decode(item)
        elif isinstance(item, Played):
            self._play_item(item)
        elif isinstance(item, LinkReport):
            self._report_link(item)
        elif isinstance(item, Ended):
            self._end()
        elif isinstance(item, Sample):
            self._sample(item)

    def command(self, request: Request) -> Reply:
        """Restart the source."""
        if self._table.replay:
            return done("a replay goes on; restart the process to play it again")
        self._stop()
        self._start_source()
        return accepted(f"{request.op}: opening {self._url.scheme} source again")

    def report(self) -> Report:
        """Tell the link, the bytes, the frames by kind and what was refused."""
        age_s = (self.context.clock.mono_ns() - self._heard_ns) * 1e-9
        state, reason = self._health(age_s)
        framing, decoding = self._decoder.framing, self._decoder.decoding
        if self._recording is not None and self._state is LinkState.ENDED:  # before it, these are its thread's
            decoding = self._recording.decoding
            framing = self._recording.framing if isinstance(self._recording, RawRecording) else framing
        newest = self._publisher.newest
        link = InputStatus(
            name=self._url.scheme,
            state=self._state.value,
            detail=self._detail,
            messages=framing.frames.total() or self._publisher.published.total(),
            bytes=self._bytes,
            age_s=age_s if self._bytes else None,
            errors=framing.checksum_failures.total() + decoding.rejected.total(),
            counters={**framing.frames, **{f"rejected {name}": count for name, count in decoding.rejected.items()}},
        )
        return Report(
            state=state,
            reason=reason,
            inputs=[link],
            counters={
                **{f"published_{name}": count for name, count in self._publisher.published.items()},
                "bytes": self._bytes,
                "bytes_skipped": framing.bytes_skipped,
                "link_errors": self._errors,
                "writes": self._writes,
                "writes_lost": self._writes_lost,
            },
            latencies={"decode": self._decode_ms},
            last_epoch=None if newest is None else (newest.time.week, newest.time.tow_s),
            data={"end": self._state is LinkState.ENDED, "satellites": 0 if newest is None else len(set(newest.satellite.tolist()))},
        )

    def close(self) -> None:
        """Stop the source."""
        self._stop()

    def _options(self) -> StreamOptions:
        near = date_of(self._table.date) or gps_now(self.context.clock)
        return StreamOptions(approximate_time=near, observations=self._table.observations)

    def _start_source(self) -> None:
        self._stop_source = threading.Event()
        if self._url.scheme == "file":
            self._thread(self._play)
        elif self._url.scheme == "sim":
            self._thread(Simulation(self._url, self.context.clock, self._sink).run)
        else:
            self._link = Link(self._url, self._sink)
            self._link.start()

    def _stop(self) -> None:
        self._stop_source.set()
        if self._link is not None:
            self._link.stop()

    def _thread(self, run: Any) -> None:
        threading.Thread(target=run, args=(self._stop_source,), daemon=True, name="source").start()

    def _play(self, stopping: threading.Event) -> None:
        """Play the recording of a file source (in its own thread)."""
        try:
            recording = self._recording = recording_of(self._url, self._table.date, self._table.observations)
            start = common_start(self._all_recordings()) if self._url.speed else None
        except SourceError as error:
            self._sink(LinkReport(LinkState.ERROR, str(error)))
            return
        pace = Pace(self.context.clock, self._url.speed, start)
        Replay(recording, pace, self._gate, self.context.clock, self._put_wait, self._publisher.sequence).run(stopping)

    def _all_recordings(self) -> Any:
        """Yield every observation recording of this deployment: they are played in step."""
        for table in self.context.deployment.ingest.values():
            if table.replay and not table.navigation and Path(parse_source(table.source).path).is_file():
                yield recording_of(parse_source(table.source), table.date, table.observations)

    def _sink(self, item: Chunk | LinkReport) -> None:
        self.context.inbox.put(item, lane="source")

    def _put_wait(self, item: Any) -> bool:
        return self.context.inbox.put_wait(item, lane="source", timeout_s=0.2)

    def _on_live(self, change: Liveliness) -> None:
        if not change.alive:
            self._gate.gone(change.id)

    def _decode(self, chunk: Chunk) -> None:
        self._bytes += len(chunk.data)
        self._heard_ns = chunk.mono_ns
        begun = self.context.clock.mono_ns()
        for frame, messages in self._decoder.feed(chunk.data):
            self._publisher.frame(frame, chunk.mono_ns)
            for message in messages:
                self._publish(message, chunk.mono_ns)
        now = self.context.clock.mono_ns()
        self._decode_ms.add(now, (now - begun) * 1e-6)

    def _play_item(self, played: Played) -> None:
        self._heard_ns = played.mono_ns
        if isinstance(played.item, Frame):
            self._bytes += len(played.item.data)
            self._publisher.frame(played.item, played.mono_ns)
        else:
            self._publish(played.item, played.mono_ns)

    def _publish(self, message: Message, mono_ns: int) -> None:
        if not isinstance(message, ReceiverFix):
            self._publisher.message(message, mono_ns)

    def _report_link(self, report: LinkReport) -> None:
        if report.state is LinkState.ERROR:
            self._errors += 1
            if (self._state, self._detail) != (report.state, report.detail):
                known = self._state is LinkState.ERROR  # else the change of state says it
                self.context.event(Level.WARNING, "source_error", f"{self._url.scheme} source: {report.detail}", logged=known)
        elif report.state is LinkState.CONNECTED:
            self.context.event(Level.INFO, "source_connected", f"receiving from {report.detail}")
        elif self._state is LinkState.ERROR and report.state is LinkState.CONNECTING:
            return  # keep showing why the last attempt failed
        self._state, self._detail = report.state, report.detail

    def _end(self) -> None:
        self._publisher.end()
        self._state, self._detail = LinkState.ENDED, "the recording is at its end"
        self.context.event(Level.INFO, "source_ended", self._detail, logged=False)

    def _sample(self, sample: Sample) -> None:
        if sample.key == WRITE.key(self.context.id):
            self._writes += 1
            if self._link is None or not self._link.write(sample.payload):
                self._writes_lost += 1
            return
        try:
            self._gate.credit(decode(Credit, sample.payload, sample.encoding))
        except (DecodeError, VersionError) as error:
            self._errors += 1
            self.context.log.warning("credit: %s", error)

    def _health(self, age_s: float) -> tuple[State, str]:
        if self._state is LinkState.ERROR:
            return State.DEGRADED, self._detail
        if self._state is LinkState.ENDED:
            return State.STOPPED, self._detail
        if not self._table.replay and age_s > STALE_S:
            return State.STALE, f"no data for {age_s:.0f} s ({self._state.value})"
        return State.RUNNING, ""


def consumers_of(context: Context) -> list[str]:
    """Return the solvers of the deployment that take this receiver's stream."""
    return [name for name, solver in context.deployment.solver.items() if context.id in (solver.rover, solver.base, *solver.navigation)]


@cache
def warm_decoder() -> None:
    """Decode an epoch of each protocol that receivers send, so that the kernels are compiled or loaded before the first byte."""
    start = GpsTime(2400, 0.0)
    satellites = [satellite_number(name) for name in ("G05", "R07", "E11", "C23")]
    signals = [signal_number(code) for code in ("1C", "1C", "1C", "2I")]
    columns = {
        "pseudorange_m": [2.2e7] * 4,
        "phase_cyc": [1.1e8] * 4,
        "doppler_hz": [10.0] * 4,
        "cn0_dbhz": [45.0] * 4,
        "lock_s": [9.0] * 4,
    }
    epoch = make_epoch(start, satellite=satellites, signal=signals, channel=[NO_CHANNEL, 1, NO_CHANNEL, NO_CHANNEL], **columns)
    decoder = StreamDecoder(StreamOptions(approximate_time=start))
    for data in (encode_rawx(epoch), *encode_epoch(epoch, 1)):
        decoder.feed(data)
    decoder.flush()


preload = warm_decoder


def create(context: Context) -> Service:
    """Return the ingest service of a context."""
    return IngestService(context)
