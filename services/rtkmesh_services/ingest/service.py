"""The ingest role: one receiver's bytes in, checked frames, epochs, ephemerides and reference position out."""

import threading
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any, ClassVar

from rtkmesh.codecs.messages import DecodingCounters, Frame, FramingCounters, Message
from rtkmesh.codecs.stream import StreamDecoder
from rtkmesh.gnss.ephemeris import ReceiverFix, ReferenceStation
from rtkmesh.gnss.receiver import ReceiverReport
from rtkmesh.gnss.receiver_options import parse_receiver_options
from rtkmesh_schemas.command import Reply, Request
from rtkmesh_schemas.config import IngestTable
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import CREDIT, SOL, WRITE, Role
from rtkmesh_schemas.observation import Credit
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import InputStatus, Level, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.commands import commands_of
from rtkmesh_services.ingest.credit import CreditGate
from rtkmesh_services.ingest.dialogue import Dialogue
from rtkmesh_services.ingest.failover import Failover
from rtkmesh_services.ingest.figures import SourceFigures
from rtkmesh_services.ingest.links import Chunk, LinkReport, LinkState
from rtkmesh_services.ingest.live import LiveSources, counters_of
from rtkmesh_services.ingest.receiver_state import ReceiverState
from rtkmesh_services.ingest.recording import RawRecording, Recording
from rtkmesh_services.ingest.replay import Ended, Pace, Played, Replay, common_start, date_of, gps_now, recording_of, stream_options
from rtkmesh_services.ingest.stream import StreamPublisher
from rtkmesh_services.ingest.urls import SourceUrl, parse_source, wants_nearest
from rtkmesh_services.ingest.warming import warm_decoder
from rtkmesh_services.mapping.position import known_position
from rtkmesh_services.ntrip.place import Place
from rtkmesh_services.runtime.bus import Liveliness, Sample
from rtkmesh_services.runtime.service import Context, Report, Service, accepted, done
from rtkmesh_services.runtime.statistics import RollingQuantiles

DEAD_CONSUMER_S = 10.0  # how long a replay as fast as it goes waits for a consumer that died
FAREWELL_S = 0.9  # for what a receiver is told at the end
STALE_S = 5.0  # a live source that is silent for so long is STALE


class IngestService(Service):
    """One receiver. All decoding and publishing happens in the work loop; links and replays have threads of their own."""

    role: ClassVar[Role] = Role.INGEST
    operations: ClassVar[Mapping[str, str]] = {"restart": "close the source and open it again", **Dialogue.operations}

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: IngestTable = context.deployment.ingest[context.id]
        self._url: SourceUrl = parse_source(self._table.source)
        raw = self._table.raw and self._url.scheme != "ingest"  # that ingest publishes them
        self._publisher = StreamPublisher(context, known_position(self._table), raw=raw)
        self._receiver = ReceiverState()
        self._gate = CreditGate(consumers_of(context), patience_s=0.0 if self._url.scheme != "file" or self._url.speed else DEAD_CONSUMER_S)
        self._decode_ms = RollingQuantiles()
        self._dialogue = Dialogue(context, self._table, self._say, self._publisher.stand_at)
        self._live = None if self._table.replay else self._live_sources()
        self._replayed = LinkReport(LinkState.CONNECTING)
        self._figures = SourceFigures(known_position(self._table))  # of a replay
        self._recording: Recording | None = None
        self._stop_source = threading.Event()
        self._bytes = self._errors = self._writes = self._writes_lost = 0
        self._heard_ns = context.clock.mono_ns()
        self._place: Place | None = None

    def warm(self) -> None:
        """Compile the decoders."""
        warm_decoder()

    def open(self) -> None:
        """Listen for credit and writes, publish the known position, start the source."""
        self.context.subscribe(CREDIT.key(self.context.id), lane="credit")
        self.context.subscribe(WRITE.key(self.context.id), lane="write")
        for solver in solvers_to_ask(self.context):
            self.context.subscribe(SOL.key(solver), lane="place")
        self.context.bus.on_live(self._on_live)
        self._dialogue.open()
        self._publisher.open()
        for note in parse_receiver_options(self._table.options).notes:
            self.context.event(Level.INFO, "receiver_option", f"nothing to do for {note}")
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

    def tick(self, now_mono_ns: int) -> None:
        """Open a further source when those that are open bring nothing; go on with corrections and surveys."""
        self._dialogue.tick(now_mono_ns * 1e-9)
        if self._live is not None and (opened := self._live.silent(now_mono_ns * 1e-9)):
            self.context.event(Level.WARNING, "source_fallback", f"nothing comes: trying {opened} as well")

    def command(self, request: Request) -> Reply:
        """Restart the source, or do what a base station is asked for."""
        if request.op in Dialogue.operations:
            return self._dialogue.command(request, self._now_s())
        if self._live is None:
            return done("a replay goes on; restart the process to play it again")
        self._live.stop()
        self._live.start()
        return accepted(f"{request.op}: opening {self._url.scheme} source again")

    def report(self) -> Report:
        """Tell the link, the bytes, the frames by kind and what was refused."""
        now_ns = self.context.clock.mono_ns()
        state, reason = self._health((now_ns - self._heard_ns) * 1e-9)
        if state is State.RUNNING and (complaint := self._dialogue.complaint(now_ns * 1e-9)):
            state, reason = State.DEGRADED, complaint
        inputs = [self._replay_status(now_ns)] if self._live is None else self._live.statuses(now_ns)
        inputs += self._dialogue.statuses(now_ns * 1e-9)
        newest = self._publisher.newest
        return Report(
            state=state,
            reason=reason,
            inputs=inputs,
            counters={
                **{f"published_{name}": count for name, count in self._publisher.published.items()},
                "bytes": self._bytes,
                "bytes_skipped": self._framing().bytes_skipped,
                "link_errors": self._errors,
                "writes": self._writes,
                "writes_lost": self._writes_lost,
                **self._publisher.made.counters(),
            },
            latencies={"decode": self._decode_ms},
            last_epoch=None if newest is None else (newest.time.week, newest.time.tow_s),
            data={
                "end": self._replayed.state is LinkState.ENDED,
                "satellites": 0 if newest is None else len(set(newest.satellite.tolist())),
                **({"source": self._live.active} if self._live is not None and self._table.fallback else {}),
                **self._dialogue.data(now_ns * 1e-9),
                **self._receiver.data(now_ns),
            },
        )

    def close(self) -> None:
        """Stop the source."""
        self._stop_source.set()
        if self._live is not None:
            self._live.stop(FAREWELL_S)

    def _new_decoder(self, url: SourceUrl) -> StreamDecoder:
        near = date_of(self._table.date) or gps_now(self.context.clock)
        return StreamDecoder(stream_options(url, self._table, near))

    def _live_sources(self) -> LiveSources:
        table = self._table
        urls = [self._url, *map(parse_source, table.fallback)]
        now_s = self.context.clock.mono_ns() * 1e-9
        failover = Failover(len(urls), table.fallback_after_s, table.return_after_s, now_s)
        commands = commands_of(table, self.context.config_folder)
        find_place = self._rover_place if solvers_to_ask(self.context) else None
        return LiveSources(
            urls, self._new_decoder, self._sink, failover, find_place, self.context.clock, commands, self.context.bus,
            self._dialogue.corrections, known_position(table),
        )  # fmt: skip

    def _now_s(self) -> float:
        return self.context.clock.mono_ns() * 1e-9

    def _say(self, data: bytes) -> bool:
        """Queue bytes for the receiver; False when nothing is connected."""
        return self._live is not None and self._live.write(data)

    def _rover_place(self) -> Place | None:
        """Return where the rover is, as its solver says (for the threads of casters)."""
        return self._place

    def _start_source(self) -> None:
        if self._live is not None:
            self._live.start()
        else:
            self._thread(self._play)

    def _thread(self, run: Any) -> None:
        threading.Thread(target=run, args=(self._stop_source,), daemon=True, name="source").start()

    def _play(self, stopping: threading.Event) -> None:
        """Play the recording of a file source (in its own thread)."""
        try:
            recording = self._recording = recording_of(self._url, self._table)
            start = common_start(self._all_recordings()) if self._url.speed else None
            start = start + self._url.number("start", 0.0) if start is not None else None
        except SourceError as error:
            self._sink(LinkReport(LinkState.ERROR, str(error)))
            return
        pace = Pace(self.context.clock, self._url.speed, start)
        Replay(recording, pace, self._gate, self.context.clock, self._put_wait, self._publisher.sequence).run(stopping)

    def _all_recordings(self) -> Any:
        """Yield every observation recording of this deployment: they are played in step."""
        for table in self.context.deployment.ingest.values():
            if table.replay and not table.navigation and Path(parse_source(table.source).path).is_file():
                yield recording_of(parse_source(table.source), table)

    def _sink(self, item: Chunk | LinkReport) -> None:
        self.context.inbox.put(item, lane="source")

    def _put_wait(self, item: Any) -> bool:
        return self.context.inbox.put_wait(item, lane="source", timeout_s=0.2)

    def _on_live(self, change: Liveliness) -> None:
        if not change.alive:
            self._gate.gone(change.id)

    def _decode(self, chunk: Chunk) -> None:
        assert self._live is not None, "chunks come from live sources"
        self._bytes += len(chunk.data)
        begun = self.context.clock.mono_ns()
        frames, switched = self._live.take(chunk)
        if switched:
            self._switched()
        if chunk.source == self._live.active:
            self._heard_ns = chunk.mono_ns
            self._dialogue.heard(chunk.data, (frame for frame, _ in frames), self._now_s())
        for frame, messages in frames:
            if self._live.decoder.options.wants(frame):
                self._publisher.frame(frame, chunk.mono_ns)
            for message in messages:
                self._publish(message, chunk.mono_ns)
        now = self.context.clock.mono_ns()
        self._decode_ms.add(now, (now - begun) * 1e-6)

    def _switched(self) -> None:
        """Another source is used from now on: another antenna, other phases."""
        assert self._live is not None, "only live sources are switched"
        self._publisher.switch(*self._live.antenna)
        _, detail = self._live.state(self._live.active)
        if not self._table.fallback:
            self.context.event(Level.INFO, "source_switched", f"now using {detail}")
            return
        choice = "the first choice" if self._live.active == 0 else f"fallback {self._live.active}"
        self.context.event(Level.WARNING if self._live.active else Level.INFO, "source_switched", f"now using {choice}: {detail}")

    def _play_item(self, played: Played) -> None:
        self._heard_ns = played.mono_ns
        if isinstance(played.item, Frame):
            self._bytes += len(played.item.data)
            self._figures.replayed(played.item, played.mono_ns)
            self._publisher.frame(played.item, played.mono_ns)
        else:
            self._figures.message(played.item, played.mono_ns)
            self._publish(played.item, played.mono_ns)

    def _publish(self, message: Message, mono_ns: int) -> None:
        self._dialogue.message(message, self._now_s())
        if isinstance(message, ReceiverReport):
            self._receiver.take(message, mono_ns, self.context.event)
        elif not isinstance(message, ReceiverFix):
            if isinstance(message, ReferenceStation):
                self._receiver.take_setup(message, mono_ns)
            self._publisher.message(message, mono_ns)

    def _report_link(self, report: LinkReport) -> None:
        self._errors += report.state is LinkState.ERROR
        known, _ = ("", "") if self._live is None else self._live.state(report.source)
        if self._live is None:
            self._replayed = report
        else:
            if report.source == 0:  # the receiver; fallbacks are other people's
                self._dialogue.link(report.state, self._now_s())
            moved, news = self._live.moved(report), self._live.report(report)
            if moved:
                self._switched()
            if not news:
                return
        if report.state is LinkState.ERROR:
            again = f"; trying again in {report.retry_s:.0f} s" if report.retry_s >= 1.0 else ""
            aside = self._live is not None and report.source != self._live.active
            logged = aside or known == LinkState.ERROR  # else the change of state says it
            self.context.event(Level.WARNING, "source_error", f"{self._url.scheme} source: {report.detail}{again}", logged=logged)
        elif report.state is LinkState.CONNECTED:
            self.context.event(Level.INFO, "source_connected", f"receiving from {report.detail}")

    def _end(self) -> None:
        self._publisher.end()
        self._replayed = LinkReport(LinkState.ENDED, "the recording is at its end")
        self.context.event(Level.INFO, "source_ended", self._replayed.detail, logged=False)

    def _sample(self, sample: Sample) -> None:
        if sample.key == WRITE.key(self.context.id):
            self._writes += 1
            if self._live is None or not self._live.write(sample.payload):
                self._writes_lost += 1
            return
        if self._dialogue.takes(sample, self._now_s()):
            return
        try:
            if sample.key == CREDIT.key(self.context.id):
                self._gate.credit(decode(Credit, sample.payload, sample.encoding))
            else:
                self._place = place_of(decode(SolutionMessage, sample.payload, sample.encoding)) or self._place
        except (DecodeError, VersionError) as error:
            self._errors += 1
            self.context.log.warning("%s: %s", sample.key, error)

    def _framing(self) -> FramingCounters:
        if self._live is not None:
            return self._live.decoder.framing
        ended = self._replayed.state is LinkState.ENDED  # before it, these are its thread's
        return self._recording.framing if ended and isinstance(self._recording, RawRecording) else FramingCounters()

    def _replay_status(self, now_ns: int) -> InputStatus:
        framing, decoding = self._framing(), DecodingCounters()
        if self._recording is not None and self._replayed.state is LinkState.ENDED:
            decoding = self._recording.decoding
        return InputStatus(
            name=self._url.scheme,
            state=self._replayed.state.value,
            detail=self._replayed.detail,
            messages=framing.frames.total() or self._publisher.published.total(),
            bytes=self._bytes,
            age_s=(now_ns - self._heard_ns) * 1e-9 if self._bytes else None,
            errors=framing.checksum_failures.total() + decoding.rejected.total(),
            counters=counters_of(framing, decoding),
            stream=self._figures.status(now_ns, framing, decoding),
        )

    def _health(self, age_s: float) -> tuple[State, str]:
        if self._live is None:
            state = {LinkState.ERROR: State.DEGRADED, LinkState.ENDED: State.STOPPED}.get(self._replayed.state, State.RUNNING)
            return state, "" if state is State.RUNNING else self._replayed.detail
        active = self._live.active
        word, detail = self._live.state(active)
        if word in (LinkState.ERROR, LinkState.ENDED):
            return State.DEGRADED if word == LinkState.ERROR else State.STOPPED, detail
        if age_s > STALE_S:
            return State.STALE, f"no data for {age_s:.0f} s ({word}{f': {detail}' if word == LinkState.WAITING else ''})"
        if complaint := self._live.complaint():
            return State.DEGRADED, complaint
        if active:
            first, why = self._live.state(0)
            return State.DEGRADED, f"using fallback {active}, {detail}; the first choice: {why if first == LinkState.ERROR else first}"
        return State.RUNNING, ""


def solvers_to_ask(context: Context) -> list[str]:
    """Return the solvers whose rover a caster may want to know the place of: those that have this ingest as their base."""
    table: IngestTable = context.deployment.ingest[context.id]
    urls = [parse_source(text) for text in (table.source, *table.fallback)]
    if not any(url.caster is not None and url.place is None and (url.word("gga") != "off" or wants_nearest(url)) for url in urls):
        return []
    return [name for name, solver in context.deployment.solver.items() if solver.base == context.id]


def place_of(solution: SolutionMessage) -> Place | None:
    """Return the place that a solution says, None if it says none."""
    if solution.status == 0 or not isfinite(solution.lat_deg + solution.lon_deg + solution.height_m):
        return None
    return Place(solution.lat_deg, solution.lon_deg, solution.height_m)


def consumers_of(context: Context) -> list[str]:
    """Return the solvers of the deployment that take this receiver's stream."""
    return [name for name, solver in context.deployment.solver.items() if context.id in (solver.rover, solver.base, *solver.navigation)]


preload = warm_decoder


def create(context: Context) -> Service:
    """Return the ingest service of a context."""
    return IngestService(context)
