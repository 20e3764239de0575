"""The solver role: one solver instance. Streams in, solutions out; commands really act on its engine."""

from collections import Counter
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

import msgspec

from rtkmesh.errors import OptionError
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.pairing import Pair
from rtkmesh.rtk.session import Session, SessionOptions, Source
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.config import IngestTable, SolverTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_schemas.keys import CREDIT, SAT, SOL, Role
from rtkmesh_schemas.observation import Credit
from rtkmesh_schemas.status import Level, State
from rtkmesh_services.errors import CommandError
from rtkmesh_services.mapping.options import navigation_only, session_options
from rtkmesh_services.mapping.position import known_position
from rtkmesh_services.mapping.solution import satellites_message, solution_message
from rtkmesh_services.runtime.bus import Liveliness, Sample
from rtkmesh_services.runtime.configuration import load_solver_table
from rtkmesh_services.runtime.service import Context, Report, Service, done
from rtkmesh_services.runtime.statistics import RollingQuantiles
from rtkmesh_services.solver.followers import Followers
from rtkmesh_services.solver.formats import publish_texts
from rtkmesh_services.solver.inputs import CREDIT_EVERY, STREAMS, InputStream
from rtkmesh_services.solver.warming import warm_engine

SATELLITES_PERIOD_NS = 1_000_000_000
READY_PERIOD_NS = 500_000_000
STALE_S = 5.0
FIRST_S = 15.0  # the same for the first observation: receivers and their processes have to start
FOLLOWERS_S = 10.0  # how long a replay is held for the processes that take the solutions: the first ones shall not be lost
HISTORY_S = 0.2  # what was cached comes first: a message that overtakes it would be taken for newer and the cached one dropped
RECEIVE_TIMES = 1024  # epochs whose arrival is remembered for the latency


class SolverService(Service):
    """One solver instance around the pure session."""

    role: ClassVar[Role] = Role.SOLVER
    operations: ClassVar[Mapping[str, str]] = {
        "start": "begin with a fresh filter",
        "stop": "no more solutions; ephemerides are still collected",
        "restart": "stop and start",
        "load": "FILE: take the [solver] table of a file below the configuration folder, with a fresh filter",
    }

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: SolverTable = context.deployment.solver[context.id]
        self._running = self._table.autostart if context.running is None else context.running
        with self._refusals():
            self._session = Session(self._session_options(self._table))
        self._inputs = {name: InputStream(name, source, self._ingest(name).replay) for source, name in self._sources()}
        self._sequence = 0
        self._statuses: Counter[str] = Counter()
        self._integrities: Counter[str] = Counter()
        self._solve_ms, self._latency_ms, self._waited_ms = RollingQuantiles(), RollingQuantiles(), RollingQuantiles()
        self._received: dict[GpsTime, int] = {}
        self._newest: Solution | None = None
        self._satellites_ns = self._ready_ns = 0
        self._opened_s = 0.0
        self._followers = Followers(context)

    def warm(self) -> None:
        """Compile or load the engine's kernels."""
        warm_engine()

    def open(self) -> None:
        """Subscribe to the streams; replays are told from the loop that we are ready."""
        self._opened_s = self._now_s()
        self._followers.watch()
        self.context.bus.on_live(self._on_live)
        for name in self._inputs:
            for stream in STREAMS:
                fields = {"satellite": "*"} if "{satellite}" in stream.template else {}
                self.context.subscribe(stream.key(name, **fields), lane=f"in:{name}", history=stream.cache > 0)

    def handle(self, item: Any) -> None:
        """Take one sample of a stream and solve what can be solved."""
        if isinstance(item, Liveliness):
            self._inputs[item.id].owner_left()
        if not isinstance(item, Sample):
            return
        stream = self._inputs.get(item.key.split("/")[1])
        if stream is None:
            return
        now_s = self._now_s()
        for arrival in stream.take(item, now_s):
            self._feed(arrival.source, arrival.message, arrival.received_mono_ns, now_s)
        self._advance()

    def tick(self, now_mono_ns: int) -> None:
        """Solve what has waited long enough; repeat the credit of replays that have not begun."""
        now_s = now_mono_ns * 1e-9
        for stream in self._inputs.values():
            for arrival in stream.overdue(now_s):
                self._feed(arrival.source, arrival.message, arrival.received_mono_ns, now_s)
        self._advance()
        if now_mono_ns - self._ready_ns >= READY_PERIOD_NS and self._is_ready():
            self._ready_ns = now_mono_ns
            self._credit(force=True)

    def due_mono_ns(self) -> float:
        """Return when the oldest waiting epoch has waited long enough."""
        return self._session.deadline_s() * 1e9

    def command(self, request: Request) -> Reply:
        """Start, stop, restart or load."""
        if request.op == "stop":
            return self._stop()
        if request.op == "load":
            return self._load(str(request.args.get("file", "")))
        if request.op == "start" and self._running:
            raise CommandError(Code.WRONG_STATE, "rtk server already started")
        return self._start("restarted" if request.op == "restart" else "started")

    def table(self) -> SolverTable:
        """Return the present options: those of the file, or of the last ``load``."""
        return self._table

    def report(self) -> Report:
        """Tell the inputs, what became of the epochs, and how long they took."""
        now_s = self._now_s()
        state, reason = self._health(now_s)
        counters, newest = self._session.pairing.counters, self._newest
        return Report(
            state=state,
            reason=reason,
            inputs=[stream.status(now_s) for stream in self._inputs.values()],
            counters={
                **{f"solutions_{name.lower()}": count for name, count in self._statuses.items()},
                **{f"integrity_{name}": count for name, count in self._integrities.items()},
                **{name: getattr(counters, name) for name in counters.__slots__},
                "waiting": len(self._session.pairing),
            },
            latencies={"solve": self._solve_ms, "latency": self._latency_ms, "waited": self._waited_ms},
            last_epoch=None if newest is None else (newest.time.week, newest.time.tow_s),
            data={
                "mode": self._table.mode,
                "rover": self._table.rover,
                "base": self._table.base,
                "end": self._ended(),
                "running": self._running,
                **({} if newest is None else _newest_words(newest)),
                "antennas": {**self._session.antennas, "corrected": self._session.corrects_antennas},
            },
        )

    def _on_live(self, change: Liveliness) -> None:
        if not change.alive and change.id in self._inputs:
            self.context.inbox.put(change, lane=f"in:{change.id}")

    def _sources(self) -> list[tuple[Source, str]]:
        table = self._table
        named = [(Source.ROVER, table.rover), (Source.BASE, table.base)]
        return [(source, name) for source, name in named if name] + [(Source.NAVIGATION, name) for name in navigation_only(table)]

    def _ingest(self, name: str) -> IngestTable:
        return self.context.deployment.ingest[name]

    def _session_options(self, table: SolverTable) -> SessionOptions:
        """Return the engine's options of a table with this solver's streams."""
        replay = all(self._ingest(name).replay for _, name in self._sources())
        known = known_position(self._ingest(table.base)) if table.base else None
        return session_options(table, replay=replay, base_position_ecef_m=known, folder=self.context.config_folder)

    @contextmanager
    def _refusals(self) -> Generator[None]:
        """Turn what the engine says of its options into the fault of a file."""
        try:
            yield
        except (OptionError, ValueError) as error:
            raise ConfigError(self.context.config_file.name, None, f"[solver.{self.context.id}] {error}") from error

    def _feed(self, source: Source, message: Any, received_mono_ns: int, now_s: float) -> None:
        if isinstance(message, Epoch):
            if not self._running:
                return
            if source is Source.ROVER:
                self._received[message.time] = received_mono_ns
                if len(self._received) > RECEIVE_TIMES:
                    del self._received[next(iter(self._received))]
        self._session.feed(source, message, now_s)

    def _advance(self) -> None:
        while self._running and (pair := self._session.next_pair(self._now_s())) is not None:
            self._solve(pair)
        self._credit()

    def _solve(self, pair: Pair) -> None:
        begun = self.context.clock.mono_ns()
        solution = self._session.solve(pair)
        solved = self.context.clock.mono_ns()
        self._newest = solution
        self._statuses[solution.status.name] += 1
        self._integrities[solution.integrity.value] += 1
        self._solve_ms.add(solved, (solved - begun) * 1e-6)
        self._waited_ms.add(solved, solution.waited_s * 1e3)
        received = self._received.pop(pair.rover.time, 0)
        if received:
            self._latency_ms.add(solved, (solved - received) * 1e-6)
        self._publish(solution, (solved - begun) * 1e-6, received, solved)

    def _publish(self, solution: Solution, solve_ms: float, received: int, now_ns: int) -> None:
        context = self.context
        message = solution_message(
            solution,
            source=context.id,
            start_id=context.start_id,
            sequence=self._sequence,
            mode=self._table.mode,
            rover=self._table.rover,
            base=self._table.base,
            solve_ms=solve_ms,
            received_mono_ns=received,
            published_mono_ns=now_ns,
        )
        self._sequence += 1
        context.bus.publish(SOL, message)
        publish_texts(context.bus, solution)
        if now_ns - self._satellites_ns >= SATELLITES_PERIOD_NS and context.bus.matched(SAT):
            self._satellites_ns = now_ns
            context.bus.publish(SAT, satellites_message(solution, context.id))

    def _is_ready(self) -> bool:
        """Return whether replays may begin: all that is cached has come, and so have those who take the solutions."""
        waited_s = self._now_s() - self._opened_s
        return waited_s >= HISTORY_S and (self._followers.here() or waited_s >= FOLLOWERS_S)

    def _credit(self, *, force: bool = False) -> None:
        """Tell replays how far we are; without ``force`` only when it is worth a message."""
        if not self._is_ready():
            return
        pending = self._session.pairing.waiting_for()
        solved = None if self._newest is None else self._newest.time
        for name, stream in self._inputs.items():
            if not stream.replay:
                continue
            until = pending if stream.source is Source.BASE and pending is not None else solved
            taken = stream.consumed(until if self._running else stream.newest) if until is not None or not self._running else -1
            if force or taken - stream.credited >= CREDIT_EVERY or (pending is not None and not self.context.inbox.depth()):
                stream.credited = taken
                credit = Credit(
                    consumer=self.context.id,
                    consumer_start_id=self.context.start_id,
                    sequence=taken,
                    ingest_start_id=stream.sequencer.start_id,
                    wanted=stream.wanted(pending, self._table.sync.max_wait_s),
                )
                self.context.bus.publish_as(name, CREDIT, credit)

    def _stop(self) -> Reply:
        if not self._running:
            raise CommandError(Code.WRONG_STATE, "rtk server already stopped")
        self._running = False
        self._session.restart()
        self.context.event(Level.INFO, "stopped", "solver stopped by command")
        return done("rtk server stop")

    def _start(self, word: str) -> Reply:
        self._running = True
        self._session.restart()
        self.context.event(Level.INFO, word, f"solver {word} with a fresh filter")
        return done(f"rtk server {'restart' if word == 'restarted' else 'start'}")

    def _load(self, file: str) -> Reply:
        if not file:
            raise CommandError(Code.BAD_ARGUMENTS, "load needs a file: load FILE")
        try:
            table = load_solver_table(file, self.context.config_folder)
        except ConfigError as error:
            raise CommandError(Code.BAD_ARGUMENTS, str(error)) from error
        table = replace_streams(table, self._table)
        with self._refusals():
            options = self._session_options(table)
            Session(options)  # refuses before anything is changed
        self._session.restart(options)
        self._table = table
        self.context.event(Level.INFO, "loaded", f"options of {file} taken, fresh filter")
        return done(f"loaded {file}", mode=table.mode)

    def _ended(self) -> bool:
        replays = [stream for stream in self._inputs.values() if stream.replay]
        return bool(replays) and all(stream.ended for stream in replays) and not len(self._session.pairing)

    def _health(self, now_s: float) -> tuple[State, str]:
        if not self._running:
            return State.STOPPED, "stopped by command"
        if self._ended():
            return State.STOPPED, "the recordings are at their end"
        rover = self._inputs[self._table.rover]
        if rover.heard_s is None and now_s - self._opened_s <= FIRST_S:
            return State.RUNNING, f"waiting for {rover.name}"
        if rover.heard_s is None or (now_s - rover.heard_s > STALE_S and not rover.replay):
            return State.STALE, f"no observations from {rover.name}"
        if strangers := [stream.name for stream in self._inputs.values() if stream.strangers]:
            return State.DEGRADED, f"two processes publish as {strangers[0]}: the one heard first is used"
        if self._newest is None:
            return State.RUNNING, "no solution yet"
        if self._newest.status in (Status.NONE, Status.SINGLE) and self._table.mode != "single":
            return State.DEGRADED, self._newest.reason.name.lower().replace("_", " ")
        return State.RUNNING, ""

    def _now_s(self) -> float:
        return self.context.clock.mono_ns() * 1e-9


def _newest_words(solution: Solution) -> dict[str, Any]:
    """Return what a status tells of the newest solution."""
    return {
        "solution": solution.status.name,
        "fix_probability": solution.fix_probability,
        "integrity": solution.integrity.value,
        "integrity_reason": solution.integrity_reason.name.lower(),
        "protection_horizontal_m": solution.protection_horizontal_m,
        "protection_vertical_m": solution.protection_vertical_m,
    }


def replace_streams(table: SolverTable, current: SolverTable) -> SolverTable:
    """Return a loaded table with the streams of the running one: ``load`` changes options, not wiring."""
    return msgspec.structs.replace(table, rover=current.rover, base=current.base, navigation=current.navigation)


preload = warm_engine


def create(context: Context) -> Service:
    """Return the solver service of a context."""
    return SolverService(context)
