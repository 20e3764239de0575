"""The attitude role: baselines, positions and headings of a vehicle's antennas in, its attitude with covariance and integrity out."""

from collections import Counter
from collections.abc import Iterable
from math import degrees, inf, radians
from typing import Any, ClassVar

import msgspec

from rtkmesh.attitude.filter_options import Outcome
from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.attitude import AttitudeMessage, HeadingMessage
from rtkmesh_schemas.candidates import CandidatesMessage
from rtkmesh_schemas.config_attitude import AttitudeTable
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import ATT, ATT_FILTERED, ATT_NMEA, CANDIDATES, HEADING, SOL, Role
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import InputStatus, Level, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.attitude.body import Body, BodyAttitude, specs_of
from rtkmesh_services.attitude.filtering import Filtering, courses_of
from rtkmesh_services.attitude.guard import Guard
from rtkmesh_services.attitude.matching import MatchedEpoch, Matcher, never
from rtkmesh_services.attitude.messages import body_message, nmea_of
from rtkmesh_services.attitude.one_baseline import attitude_message, body_of_length, chosen_message, chosen_solution, mounting_of
from rtkmesh_services.attitude.readings import Reading, SourceKind, SourceSpec, of_heading, of_solution, time_of
from rtkmesh_services.attitude.warming import warm_body, warm_choice
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.service import Context, Report, Service
from rtkmesh_services.runtime.statistics import RollingQuantiles

STALE_S = 5.0
FIRST_S = 15.0  # the same for the first solution: the solver has to start
REPLAY_WAIT_S = 10.0  # a replay is worth waiting for what a loaded machine brings late
REPLAY_LANE = 1 << 16  # solutions of a replay that runs as fast as it can: none is dropped


class AttitudeService(Service):
    """Attitude of one vehicle. A table without places of antennas is one baseline, each of whose solutions is an attitude."""

    role: ClassVar[Role] = Role.ATTITUDE

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: AttitudeTable = context.deployment.attitude[context.id]
        self._mounting = mounting_of(self._table)
        self._unseen_rad = radians(self._table.unseen_tilt_deg)
        self._specs = {spec.id: spec for spec in specs_of(self._table, context.deployment)}
        self._body = Body(self._table, tuple(self._specs.values())) if self._table.antennas or not self._table.solver else None
        self._of_length = None if self._body else body_of_length(self._table, next(iter(self._specs.values())))
        body = self._body or self._of_length
        self._geometry = None if body is None else body.geometry
        layout = None if self._body is None else self._body.layout
        self._guard = Guard(self._table, layout, context.deployment.solver)
        self._points = {name: point.position_m for name, point in self._table.points.items()}
        self._replay = any(table.replay for table in context.deployment.ingest.values())
        wait_s = max(self._table.wait_s, REPLAY_WAIT_S) if self._replay else self._table.wait_s
        wanted = never if self._geometry is None else self._geometry.wanted
        self._matcher = Matcher(tuple(self._specs), wait_s, slowest=self._table.rate == "slowest", wanted=wanted)
        self._filtering = self._filter_of(self._table)
        self._imu = "" if self._table.imu is None else self._table.imu.key
        self._at_gyro = self._table.filter is not None and self._table.filter.publish == "gyro"
        self._sequence = self._filtered = 0
        self._messages: Counter[str] = Counter()
        self._errors: Counter[str] = Counter()
        self._heard_s: dict[str, float] = {}
        self._opened_s = 0.0
        self._last: AttitudeMessage | None = None
        self._counts: Counter[str] = Counter()
        self._latency_ms, self._published_ms = RollingQuantiles(), RollingQuantiles()

    def _filter_of(self, table: AttitudeTable) -> Filtering | None:
        if self._body is None or table.filter is None:
            return None
        courses = None if table.course is None else courses_of(table, self._specs[table.course.position].end)
        return Filtering(table, table.filter, self._unseen_rad, courses)

    def warm(self) -> None:
        """Compile or load the kernels of the body, and of the choice of integers."""
        if self._body is not None or self._of_length is not None:
            warm_body()
        if self._geometry is not None:
            warm_choice()

    def open(self) -> None:
        """Subscribe to the sources."""
        self._opened_s = self._now_s()
        if self._replay:
            self.context.inbox.lane("sol", capacity=REPLAY_LANE)
        self.context.bus.matched(ATT_NMEA)  # declares it: listeners are known before the first attitude
        for name in self._specs:
            stream = HEADING if name in self._table.headings else SOL
            self.context.subscribe(stream.key(name), lane="sol")
            if self._geometry is not None and self._specs[name].kind is SourceKind.BASELINE:
                self.context.subscribe(CANDIDATES.key(name), lane="sol")
        if self._imu:
            self.context.subscribe(self._imu, lane="imu")

    def handle(self, item: Any) -> None:
        """Take one message of a source; publish the attitudes that are complete with it."""
        if not isinstance(item, Sample):
            return
        if item.key == self._imu:
            self._take_imu(item)
            return
        spec = self._specs[item.key.split("/")[1]]
        try:
            if item.key == CANDIDATES.key(spec.id):
                self._take_candidates(spec, item)
                return
            self._heard_s[spec.id] = self._now_s()
            self._messages[spec.id] += 1
            self._take(spec, item)
        except (DecodeError, VersionError):
            self._errors[spec.id] += 1

    def tick(self, now_mono_ns: int) -> None:
        """Publish the attitudes that have waited for long enough."""
        self._publish_all(self._matcher.ready(now_mono_ns * 1e-9))

    def due_mono_ns(self) -> float:
        """Return when the next attitude has waited for long enough."""
        due_s = self._matcher.due_s()
        return due_s * 1e9 if due_s < inf else inf

    def report(self) -> Report:
        """Tell how old the inputs are and how the attitudes were."""
        state, reason = self._health()
        last = self._last
        return Report(
            state=state,
            reason=reason,
            inputs=[self._input(name) for name in self._specs] + self._imu_input(),
            counters=self._counters(),
            latencies={"latency": self._latency_ms, "publish": self._published_ms},
            last_epoch=None if last is None else (last.week, last.tow_s),
        )

    def _take(self, spec: SourceSpec, item: Sample) -> None:
        if self._body is None and self._of_length is None:
            solution = decode(SolutionMessage, item.payload, item.encoding)
            antennas = [spec.start, spec.end]
            message = attitude_message(solution, self._table, self._mounting, antennas, self._identity())
            self._publish(self._guard.of_line(message, solution), item.received_mono_ns)
            return
        reading = self._reading(spec, item)
        if reading is None:
            self._counts["untimed"] += 1
            return
        self._publish_all(self._matcher.take(reading, self._now_s(), item.received_mono_ns))

    def _take_candidates(self, spec: SourceSpec, item: Sample) -> None:
        """Take the candidates of a baseline's integers; they are counted only where they come too late."""
        message = decode(CandidatesMessage, item.payload, item.encoding)
        time = time_of(message.week, message.tow_s)
        self._publish_all(self._matcher.take_candidates(spec.id, time, message, self._now_s(), item.received_mono_ns))

    def _reading(self, spec: SourceSpec, item: Sample) -> Reading | None:
        if spec.heading is None or self._body is None:
            return of_solution(spec, decode(SolutionMessage, item.payload, item.encoding), accept_float=self._table.accept_float)
        message = decode(HeadingMessage, item.payload, item.encoding)
        return of_heading(spec, message, self._body.length_m(spec), self._unseen_rad)

    def _publish_all(self, epochs: Iterable[MatchedEpoch]) -> None:
        for epoch in epochs:
            if not epoch.whole:
                self._counts["deadlines"] += 1
            if self._body is None:
                self._publish_one(epoch)
                continue
            found = self._body.attitude(epoch)
            message = body_message(found, self._body.layout, self._points, self._unseen_rad, **self._identity())
            message = self._guard.of_body(found, message)
            self._tell(found, message)
            message = self._publish(message, epoch.arrived_mono_ns)
            self._filter(found, message, epoch.readings.values())

    def _publish_one(self, epoch: MatchedEpoch) -> None:
        """Publish the attitude of a baseline of known length."""
        chosen = None if self._of_length is None else self._of_length.choice(epoch)
        [reading] = (epoch if chosen is None else chosen).readings.values()
        solution = chosen_solution(reading, chosen)
        message = chosen_message(reading, solution, chosen, self._table, self._mounting, self._identity())
        self._publish(self._guard.of_line(message, solution), epoch.arrived_mono_ns)

    def _publish(self, message: AttitudeMessage, arrived_ns: int) -> AttitudeMessage:
        """Publish an attitude and return it as it was; ``arrived_ns``: when the bus had the last message that it is made of."""
        now_ns = self.context.clock.mono_ns()
        waited_ms = (now_ns - arrived_ns) * 1e-6
        self._last = message = msgspec.structs.replace(message, published_mono_ns=now_ns, waited_ms=waited_ms)
        self._counts[f"attitudes_{message.integrity}"] += 1
        self.context.bus.publish(ATT, message)
        now_ns = self.context.clock.mono_ns()
        if self.context.bus.matched(ATT_NMEA):
            self.context.bus.publish(ATT_NMEA, nmea_of(message))
        self._published_ms.add(now_ns, (now_ns - arrived_ns) * 1e-6)
        if message.received_mono_ns:
            self._latency_ms.add(now_ns, (now_ns - message.received_mono_ns) * 1e-6)
        return message

    def _filter(self, found: BodyAttitude, message: AttitudeMessage, readings: Iterable[Reading]) -> None:
        """Give an epoch to the filter and publish what it says of this instant; that it began anew is told."""
        if self._filtering is None:
            return
        update = self._filtering.epoch(found)
        if update is not None and update.outcome is Outcome.RESET:
            jump_deg = degrees(update.jump_rad)
            text = f"the attitude filter began anew: by {jump_deg:.1f} deg ({update.why.value})"
            self.context.event(Level.WARNING, "attitude_reset", text, jump_deg=jump_deg)
        self._filtering.moved(readings)
        self._publish_filtered(found.time, message, found)

    def _take_imu(self, item: Sample) -> None:
        if self._filtering is None:
            return
        self._messages[self._imu] += 1
        try:
            time = self._filtering.imu(item.payload, item.encoding)
        except DecodeError:
            self._errors[self._imu] += 1
            return
        if self._at_gyro and self._last is not None:
            self._publish_filtered(time, self._last, None)

    def _publish_filtered(self, time: GpsTime, epoch: AttitudeMessage, found: BodyAttitude | None) -> None:
        assert self._filtering is not None, "there is a filter"
        now_ns = self.context.clock.mono_ns()
        identity = {"sequence": self._filtered, "published_mono_ns": now_ns}
        self._filtered += 1
        self.context.bus.publish(ATT_FILTERED, self._filtering.message(time, epoch, found, **identity))

    def _tell(self, found: BodyAttitude, message: AttitudeMessage) -> None:
        """Tell when the antennas are others than those of the last attitude."""
        before = None if self._last is None else (self._last.antennas_used, self._last.antennas_excluded)
        if before == (message.antennas_used, message.antennas_excluded):
            return
        count, of = len(message.antennas_used), len(message.antennas)
        text = f"attitude from {count} of {of} antennas" + (f": {message.reason}" if message.reason else "")
        level = Level.INFO if count == of else Level.WARNING
        used, excluded = list(found.used), list(found.judged.excluded)
        self.context.event(level, "antennas_changed", text, used=used, excluded=excluded, missing=found.missing)

    def _identity(self) -> dict[str, Any]:
        self._sequence += 1
        return {"source": self.context.id, "start_id": self.context.start_id, "sequence": self._sequence - 1}

    def _now_s(self) -> float:
        return self.context.clock.mono_ns() * 1e-9

    def _input(self, name: str) -> InputStatus:
        age_s = None if name not in self._heard_s else self._now_s() - self._heard_s[name]
        state = "waiting" if age_s is None else "silent" if age_s > STALE_S else "receiving"
        late = self._matcher.late[name]
        late_candidates = self._matcher.late_candidates[name]
        counters = ({"late": late} if late else {}) | ({"late_candidates": late_candidates} if late_candidates else {})
        detail, messages, errors = self._specs[name].kind.value, self._messages[name], self._errors_of(name)
        return InputStatus(name=name, state=state, detail=detail, messages=messages, age_s=age_s, errors=errors, counters=counters)

    def _errors_of(self, name: str) -> int:
        return self._errors[name] + (0 if self._geometry is None else self._geometry.errors[name])

    def _imu_input(self) -> list[InputStatus]:
        if not self._imu:
            return []
        messages, errors = self._messages[self._imu], self._errors[self._imu]
        return [InputStatus(name=self._imu, state="receiving" if messages else "waiting", detail="imu", messages=messages, errors=errors)]

    def _counters(self) -> dict[str, int]:
        matched = {"late": self._matcher.late.total(), "between": self._matcher.skipped, "restarts": self._matcher.restarts}
        matched["late_candidates"] = self._matcher.late_candidates.total()
        matched |= {} if self._geometry is None else self._geometry.counts
        filtered = {} if self._filtering is None else {f"filter_{name}": count for name, count in self._filtering.counts.items()}
        return {**self._counts, **filtered, **{name: count for name, count in matched.items() if count}}

    def _health(self) -> tuple[State, str]:
        age_s = min((self._now_s() - heard_s for heard_s in self._heard_s.values()), default=None)
        names = ", ".join(self._specs)
        if age_s is None and self._now_s() - self._opened_s <= FIRST_S:
            return State.RUNNING, f"waiting for {names}"
        if age_s is None or age_s > STALE_S:
            return State.STALE, f"no solutions from {names}"
        last = self._last
        if last is not None and (last.integrity != Integrity.OK.value or len(last.antennas_used) < len(last.antennas)):
            return State.DEGRADED, last.reason
        return State.RUNNING, ""


preload = warm_choice


def create(context: Context) -> Service:
    """Return the attitude service of a context."""
    return AttitudeService(context)
