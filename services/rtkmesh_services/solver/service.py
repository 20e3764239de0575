"""The solver role: one solver instance. Streams in, solutions out; commands really act on its engine."""

from collections import Counter
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

from rtkmesh.errors import OptionError
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.continuation import Continuation
from rtkmesh.rtk.pairing import Pair
from rtkmesh.rtk.session import Session, SessionOptions, Source
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh_schemas.command import Reply, Request
from rtkmesh_schemas.config import IngestTable, SolverTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_schemas.keys import CANDIDATES, CREDIT, SAT, SOL, Role
from rtkmesh_schemas.observation import Credit
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import Level, ServiceStatus, State
from rtkmesh_services.mapping.candidates import candidates_message
from rtkmesh_services.mapping.options import navigation_only, session_options
from rtkmesh_services.mapping.position import known_position
from rtkmesh_services.mapping.solution import satellites_message, solution_message
from rtkmesh_services.runtime.bus import Liveliness, Sample
from rtkmesh_services.runtime.faults import Fault, time_of
from rtkmesh_services.runtime.service import Context, Report, Service
from rtkmesh_services.runtime.statistics import RollingQuantiles
from rtkmesh_services.solver.bases import OPERATIONS as BASE_OPERATIONS
from rtkmesh_services.solver.bases import BaseChanger, Subscriptions, Wiring, ingest_of
from rtkmesh_services.solver.beginnings import Beginnings
from rtkmesh_services.solver.broadcast import Broadcast
from rtkmesh_services.solver.followers import Followers
from rtkmesh_services.solver.formats import TextPublisher
from rtkmesh_services.solver.inputs import CREDIT_EVERY, InputStream
from rtkmesh_services.solver.known_lengths import known_lengths
from rtkmesh_services.solver.neighbours import Neighbours
from rtkmesh_services.solver.recent import Recent
from rtkmesh_services.solver.screens.status import StatusView, status_data, status_screen
from rtkmesh_services.solver.settings import Settings
from rtkmesh_services.solver.warming import warm_engine
from rtkmesh_services.solver.words import OPERATIONS, Words

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
    operations: ClassVar[Mapping[str, str]] = {**OPERATIONS, **BASE_OPERATIONS}

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        table = context.deployment.solver[context.id]
        self.settings = Settings(table, self._check, self._go_on)
        self.running = table.autostart if context.running is None else context.running
        with self._refusals():
            self.session = Session(self._session_options(table))
        self._lengths = known_lengths(context.deployment)
        self.recent, self.neighbours = Recent(), Neighbours(context.deployment, context.id)
        self._words, self._broadcast = Words(self), Broadcast(context, self._screen)
        self._inputs = {name: InputStream(name, source, self._ingest(name).replay) for source, name in self._sources()}
        self._sequence, self._beginnings = 0, Beginnings()
        self._statuses: Counter[str] = Counter()
        self._integrities: Counter[str] = Counter()
        self._solve_ms, self._latency_ms, self._waited_ms = RollingQuantiles(), RollingQuantiles(), RollingQuantiles()
        self._received: dict[GpsTime, int] = {}
        self._started_s: float | None = None
        self._satellites_ns = self._ready_ns = 0
        self._opened_s = 0.0
        self._followers = Followers(context)
        self._texts = TextPublisher()
        self._subscriptions = Subscriptions(context)
        self._bases = BaseChanger(
            Wiring(
                context,
                self.session,
                self._inputs,
                self._subscriptions,
                lambda: self.settings.active,
                self.settings.take_base,
                self._session_options,
            )
        )

    def warm(self) -> None:
        """Compile or load the engine's kernels."""
        warm_engine()

    def open(self) -> None:
        """Subscribe to the streams; replays are told from the loop that we are ready."""
        self._opened_s = self._now_s()
        self._started_s = self._opened_s if self.running else None
        self._followers.watch()
        self.neighbours.watch(self.context)
        self.context.bus.on_live(self._on_live)
        for name in self._inputs:
            self._subscriptions.open(name)

    def handle(self, item: Any) -> None:
        """Take one sample of a stream and solve what can be solved."""
        if isinstance(item, Liveliness):
            self._owner_left(item.id)
        if not isinstance(item, Sample):
            return
        name, now_s = item.key.split("/")[1], self._now_s()
        if self.neighbours.take(item) or self._bases.takes(name, item, now_s):
            pass
        elif (stream := self._inputs.get(name)) is not None:
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
        self._broadcast.tick(now_mono_ns)

    def due_mono_ns(self) -> float:
        """Return when the oldest waiting epoch has waited long enough."""
        return self.session.deadline_s() * 1e9

    def command(self, request: Request) -> Reply:
        """Answer one of RTKRCV's words, or change the base."""
        if request.op in BASE_OPERATIONS:
            with self._refusals():
                return self._bases.command(request, self._now_s())
        return self._words.answer(request)

    def table(self) -> SolverTable:
        """Return the present options: those of the file, or of the last ``load`` and ``set``."""
        return self.settings.pending

    def status_screen(self, status: ServiceStatus) -> tuple[str, dict[str, Any]]:  # noqa: ARG002  the hook's form
        """Return RTKRCV's status page, and what it tells beside the status."""
        view = self._view()
        return status_screen(view), {"details": status_data(view)}

    def report(self) -> Report:
        """Tell the inputs, what became of the epochs, and how long they took."""
        now_s = self._now_s()
        state, reason = self._health(now_s)
        table = self.settings.active
        counters, newest = self.session.pairing.counters, self.recent.solution
        return Report(
            state=state,
            reason=reason,
            inputs=[stream.status(now_s) for stream in self._inputs.values()] + self._bases.statuses(now_s),
            counters={
                **{f"solutions_{name.lower()}": count for name, count in self._statuses.items()},
                **{f"integrity_{name}": count for name, count in self._integrities.items()},
                **{name: getattr(counters, name) for name in counters.__slots__},
                "waiting": len(self.session.pairing),
            },
            latencies={"solve": self._solve_ms, "latency": self._latency_ms, "waited": self._waited_ms},
            last_epoch=None if newest is None else (newest.time.week, newest.time.tow_s),
            data={
                "mode": table.mode,
                "rover": table.rover,
                "base": table.base,
                "options_waiting": self.settings.waiting,
                **self._bases.data(now_s),
                "end": self._ended(),
                "running": self.running,
                **({} if newest is None else _newest_words(newest)),
                "antennas": {**self.session.antennas, "corrected": self.session.corrects_antennas},
            },
        )

    def _on_live(self, change: Liveliness) -> None:
        if not change.alive:
            self.context.inbox.put(change, lane=f"in:{change.id}")

    def _owner_left(self, name: str) -> None:
        self._bases.owner_left(name)
        if (stream := self._inputs.get(name)) is not None:
            stream.owner_left()

    def _sources(self) -> list[tuple[Source, str]]:
        table = self.settings.active
        named = [(Source.ROVER, table.rover), (Source.BASE, table.base)]
        return [(source, name) for source, name in named if name] + [(Source.NAVIGATION, name) for name in navigation_only(table)]

    def _ingest(self, name: str) -> IngestTable:
        return ingest_of(self.context, name)

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
            self.recent.epoch(source, message)
            if not self.running:
                return
            if source is Source.ROVER:
                self._received[message.time] = received_mono_ns
                if len(self._received) > RECEIVE_TIMES:
                    del self._received[next(iter(self._received))]
        self.session.feed(source, message, now_s)

    def _advance(self) -> None:
        self._bases.advance(self._now_s())
        while self.running and (pair := self.session.next_pair(self._now_s())) is not None:
            self._solve(pair)
        self._credit()

    def _solve(self, pair: Pair) -> None:
        begun = self.context.clock.mono_ns()
        solution = self.session.solve(pair)
        solved = self.context.clock.mono_ns()
        self._bases.solved(solution)
        self._tell_beginning(solution)
        self._statuses[solution.status.name] += 1
        self._integrities[solution.integrity.value] += 1
        self._solve_ms.add(solved, (solved - begun) * 1e-6)
        self._waited_ms.add(solved, solution.waited_s * 1e3)
        received = self._received.pop(pair.rover.time, 0)
        if received:
            self._latency_ms.add(solved, (solved - received) * 1e-6)
        self._publish(solution, (solved - begun) * 1e-6, received, solved)

    def _tell_beginning(self, solution: Solution) -> None:
        """Announce that the filter began anew by itself, with what that did to the position."""
        begun = self._beginnings.solved(solution, moving_base=self.settings.active.mode == "moving-base")
        if begun is not None:
            self.context.event(Level.WARNING if begun.is_alarming else Level.INFO, "filter_reset", begun.text, **begun.data)

    def _publish(self, solution: Solution, solve_ms: float, received: int, now_ns: int) -> None:
        context = self.context
        message = solution_message(
            solution,
            source=context.id,
            start_id=context.start_id,
            sequence=self._sequence,
            mode=self.settings.active.mode,
            rover=self.settings.active.rover,
            base=self.settings.active.base,
            base_station_id=0 if self.session.station is None else self.session.station.station_id,
            solve_ms=solve_ms,
            received_mono_ns=received,
            published_mono_ns=now_ns,
            candidates=self._tells_candidates(solution),
        )
        self._sequence += 1
        if fault := self.recent.solved(solution, message):
            context.faults.add(Fault(time_of(solution.time), "warning", solution.reason.name.lower(), fault))
        context.bus.publish(SOL, message)
        if message.candidates:
            self._publish_candidates(solution, message)
        self._broadcast.solved(message)
        self._texts.publish(context.bus, solution, message)
        due = self._followers.wants_satellites or now_ns - self._satellites_ns >= SATELLITES_PERIOD_NS
        if due and context.bus.matched(SAT):
            self._satellites_ns = now_ns
            context.bus.publish(SAT, satellites_message(solution, context.id))

    def _tells_candidates(self, solution: Solution) -> bool:
        """Return whether somebody, an attitude process, wants the integers that may be those of this baseline, and there may be some."""
        moving = self.settings.active.mode == "moving-base" and solution.status in (Status.FIX, Status.FLOAT)
        return moving and self.context.bus.matched(CANDIDATES)

    def _publish_candidates(self, solution: Solution, message: SolutionMessage) -> None:
        """Tell the candidates that the solution promised, also when there are none: nobody waits for them then."""
        names = ("source", "start_id", "sequence", "rover", "base", "received_mono_ns")
        identity = {name: getattr(message, name) for name in names}
        now_ns, length = self.context.clock.mono_ns(), self._lengths.get((message.base, message.rover))
        told = candidates_message(self.session.engine.candidates(length), solution, published_mono_ns=now_ns, **identity)
        self.context.bus.publish(CANDIDATES, told)

    def _is_ready(self) -> bool:
        """Return whether replays may begin: all that is cached has come, and so have those who take the solutions."""
        waited_s = self._now_s() - self._opened_s
        return waited_s >= HISTORY_S and (self._followers.here() or waited_s >= FOLLOWERS_S)

    def _credit(self, *, force: bool = False) -> None:
        """Tell replays how far we are; without ``force`` only when it is worth a message."""
        if not self._is_ready():
            return
        pending = self.session.pairing.waiting_for()
        solved = None if self.recent.solution is None else self.recent.solution.time
        for name, stream in self._inputs.items():
            if not stream.replay:
                continue
            until = pending if stream.source is Source.BASE and pending is not None else solved
            taken = stream.consumed(until if self.running else stream.newest) if until is not None or not self.running else -1
            if force or taken - stream.credited >= CREDIT_EVERY or (pending is not None and not self.context.inbox.depth()):
                stream.credited = taken
                credit = Credit(
                    consumer=self.context.id,
                    consumer_start_id=self.context.start_id,
                    sequence=taken,
                    ingest_start_id=stream.sequencer.start_id,
                    wanted=stream.wanted(pending, self.session.options.pairing.reach_s),
                )
                self.context.bus.publish_as(name, CREDIT, credit)

    def stop(self) -> None:
        """Solve nothing from now on."""
        self.running, self._started_s = False, None
        self.session.restart()
        self._fresh()
        self.context.event(Level.INFO, "stopped", "solver stopped by command")

    def begin(self, word: str) -> None:
        """Begin with a fresh filter and the options that wait for it; ConfigError changes nothing."""
        with self._refusals():
            self.session.restart(self._session_options(self.settings.pending))
        self.settings.restarted()
        self.running, self._started_s = True, self._now_s()
        self._fresh()
        self.context.event(Level.INFO, word, f"solver {word} with a fresh filter")

    def _fresh(self) -> None:
        """Somebody asked for a fresh filter: what was before is not compared with it."""
        self.recent.fresh()
        self._beginnings = Beginnings()

    def _check(self, table: SolverTable) -> None:
        """Refuse (ConfigError) what the engine refuses, before anything is changed."""
        with self._refusals():
            Session(self._session_options(table), self.session.table)

    def _go_on(self, table: SolverTable) -> Continuation:
        """Let the filter go on under other options, or say why it cannot."""
        if not self.running:
            return Continuation("the solver is stopped")
        if table.antex != self.settings.active.antex:
            return Continuation("antennas are looked up when the filter begins")
        try:
            with self._refusals():
                return self.session.go_on(self._session_options(table))
        except ConfigError as error:
            return Continuation(error.message)

    def _screen(self, word: str) -> str:
        return status_screen(self._view()) if word == "status" else self._words.screen(word)

    def _view(self) -> StatusView:
        """Return what the status page is made of."""
        solving, settings = self._solve_ms.quantiles(self.context.clock.mono_ns()), self.settings
        return StatusView(
            inputs=self._inputs,
            counters=self.report().counters,
            table=settings.active,
            running=self.running,
            ran_s=0.0 if self._started_s is None else self._now_s() - self._started_s,
            cycle_ms=self.tick_s * 1e3,
            solve_ms=0.0 if solving is None else solving.p50,
            solution=self.recent.solution,
            interval_s=self.recent.interval_s,
            overview=self.session.engine.overview(),
            neighbours=self.neighbours,
            antennas=self.session.antennas,
        )

    def _ended(self) -> bool:
        replays = [stream for stream in self._inputs.values() if stream.replay]
        return bool(replays) and all(stream.ended for stream in replays) and not len(self.session.pairing)

    def _health(self, now_s: float) -> tuple[State, str]:
        if not self.running:
            return State.STOPPED, "stopped by command"
        if self._ended():
            return State.STOPPED, "the recordings are at their end"
        rover = self._inputs[self.settings.active.rover]
        if rover.heard_s is None and now_s - self._opened_s <= FIRST_S:
            return State.RUNNING, f"waiting for {rover.name}"
        if rover.heard_s is None or (now_s - rover.heard_s > STALE_S and not rover.replay):
            return State.STALE, f"no observations from {rover.name}"
        if strangers := [stream.name for stream in self._inputs.values() if stream.strangers]:
            return State.DEGRADED, f"two processes publish as {strangers[0]}: the one heard first is used"
        if self.recent.solution is None:
            return State.RUNNING, "no solution yet"
        if self.recent.solution.status in (Status.NONE, Status.SINGLE) and self.settings.active.mode != "single":
            return State.DEGRADED, self.recent.solution.reason.name.lower().replace("_", " ")
        return State.RUNNING, ""

    def _now_s(self) -> float:
        return self.context.clock.mono_ns() * 1e-9


def _newest_words(solution: Solution) -> dict[str, Any]:
    """Return what a status tells of the newest solution."""
    return {
        "solution": solution.status.name,
        **({"position_ecef_m": [round(x, 1) for x in solution.position_ecef_m.tolist()]} if solution.status is not Status.NONE else {}),
        "fix_probability": solution.fix_probability,
        "integrity": solution.integrity.value,
        "integrity_reason": solution.integrity_reason.name.lower(),
        "protection_horizontal_m": solution.protection_horizontal_m,
        "protection_vertical_m": solution.protection_vertical_m,
    }


preload = warm_engine


def create(context: Context) -> Service:
    """Return the solver service of a context."""
    return SolverService(context)
