"""The attitude role: a moving-base solver's baselines in, heading and tilt with covariance and integrity out."""

from collections import Counter
from math import isfinite, nan, radians
from typing import Any, ClassVar

import numpy as np

from rtkmesh.attitude.baseline import BaselineAttitude, Integrity, Mounting, baseline_attitude, length_error_m, length_integrity
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.config import AttitudeTable
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import ATT, SOL, Role
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import InputStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.service import Context, Report, Service
from rtkmesh_services.runtime.statistics import RollingQuantiles

FIX, FLOAT = 1, 2
STALE_S = 5.0
FIRST_S = 15.0  # the same for the first solution: the solver has to start


class AttitudeService(Service):
    """Heading and one tilt angle of one baseline."""

    role: ClassVar[Role] = Role.ATTITUDE

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: AttitudeTable = context.deployment.attitude[context.id]
        self._mounting = mounting_of(self._table)
        solver = context.deployment.solver.get(self._table.solver)
        self._antennas = [] if solver is None else [solver.base, solver.rover]
        self._sequence = self._errors = 0
        self._heard_s: float | None = None
        self._opened_s = 0.0
        self._last: AttitudeMessage | None = None
        self._counts: Counter[str] = Counter()
        self._latency_ms = RollingQuantiles()

    def open(self) -> None:
        """Subscribe to the solver."""
        self._opened_s = self._now_s()
        self.context.subscribe(SOL.key(self._table.solver), lane="sol")

    def handle(self, item: Any) -> None:
        """Turn one solution into an attitude."""
        if not isinstance(item, Sample):
            return
        self._heard_s = self._now_s()
        try:
            solution = decode(SolutionMessage, item.payload, item.encoding)
        except (DecodeError, VersionError):
            self._errors += 1
            return
        now_ns = self.context.clock.mono_ns()
        message = attitude_message(solution, self._table, self._mounting, self._antennas, self._identity(now_ns))
        self._last = message
        self._counts[message.integrity] += 1
        if solution.received_mono_ns:
            self._latency_ms.add(now_ns, (now_ns - solution.received_mono_ns) * 1e-6)
        self.context.bus.publish(ATT, message)

    def report(self) -> Report:
        """Tell how old the input is and how the attitudes were."""
        age_s = None if self._heard_s is None else self._now_s() - self._heard_s
        state, reason = self._health(age_s)
        last = self._last
        return Report(
            state=state,
            reason=reason,
            inputs=[InputStatus(name=self._table.solver, state=state.value, messages=self._sequence, age_s=age_s, errors=self._errors)],
            counters={f"attitudes_{name}": count for name, count in self._counts.items()},
            latencies={"latency": self._latency_ms},
            last_epoch=None if last is None else (last.week, last.tow_s),
        )

    def _identity(self, now_ns: int) -> dict[str, Any]:
        identity = {"source": self.context.id, "start_id": self.context.start_id, "sequence": self._sequence, "published_mono_ns": now_ns}
        self._sequence += 1
        return identity

    def _now_s(self) -> float:
        return self.context.clock.mono_ns() * 1e-9

    def _health(self, age_s: float | None) -> tuple[State, str]:
        if age_s is None and self._now_s() - self._opened_s <= FIRST_S:
            return State.RUNNING, f"waiting for {self._table.solver}"
        if age_s is None or age_s > STALE_S:
            return State.STALE, f"no solutions from {self._table.solver}"
        if self._last is not None and self._last.integrity != Integrity.OK.value:
            return State.DEGRADED, self._last.reason
        return State.RUNNING, ""


def mounting_of(table: AttitudeTable) -> Mounting:
    """Return the engine's mounting of an attitude table."""
    return Mounting(radians(table.mounting_deg), radians(table.mounting_pitch_deg), table.length_m, table.length_tolerance_m)


def attitude_message(
    solution: SolutionMessage, table: AttitudeTable, mounting: Mounting, antennas: list[str], identity: dict[str, Any]
) -> AttitudeMessage:
    """Return the attitude of one solution; unavailable ones carry NaN and the reason, never a heading of zero."""
    usable = solution.status == FIX or (table.accept_float and solution.status == FLOAT)
    attitude = _attitude_of(solution, mounting) if usable else None
    integrity, reason = _judge(solution, attitude, mounting)
    return AttitudeMessage(
        week=solution.week,
        tow_s=solution.tow_s,
        status=solution.status,
        status_name=solution.status_name,
        integrity=integrity.value,
        reason=reason,
        heading_rad=nan if attitude is None else attitude.heading_rad,
        pitch_rad=nan if attitude is None else attitude.pitch_rad,
        roll_rad=nan if attitude is None else attitude.roll_rad,
        yaw_enu_rad=nan if attitude is None else attitude.yaw_enu_rad,
        covariance_rad2=(nan,) * 9 if attitude is None else tuple(attitude.cov_rad2.ravel().tolist()),
        baseline_length_m=nan if attitude is None else attitude.length_m,
        length_error_m=nan if attitude is None else length_error_m(attitude, mounting),
        antennas=antennas,
        age_s=solution.age_s,
        received_mono_ns=solution.received_mono_ns,
        **identity,
    )


def _attitude_of(solution: SolutionMessage, mounting: Mounting) -> BaselineAttitude | None:
    baseline = np.array(solution.baseline_enu_m)
    if not np.isfinite(baseline).all():
        return None
    attitude = baseline_attitude(baseline, np.array(solution.baseline_cov_enu_m2).reshape(3, 3), mounting)
    return attitude if isfinite(attitude.heading_rad) else None


def _judge(solution: SolutionMessage, attitude: BaselineAttitude | None, mounting: Mounting) -> tuple[Integrity, str]:
    if attitude is None:
        return Integrity.UNAVAILABLE, f"baseline is {solution.status_name}: {solution.reason}"
    if solution.integrity == Integrity.FAILED.value:
        return Integrity.FAILED, f"baseline fails its integrity test: {solution.integrity_reason}"
    if length_integrity(attitude, mounting) is Integrity.FAILED:
        return Integrity.FAILED, f"baseline is {attitude.length_m:.3f} m, known length is {mounting.length_m:.3f} m"
    return Integrity.OK, ""


def create(context: Context) -> Service:
    """Return the attitude service of a context."""
    return AttitudeService(context)
