"""What every attitude filter does with its inputs, whatever its states: gates, starts, resets, and the order of time.

Decisions are final: what was accepted stays accepted when a late input takes its place and later ones are done again, and what was
announced stays true. Gated measurements are forgotten, unless ``persistence`` of them in a row agree with each other: then the filter is
wrong, not they, and it starts anew from the last of them. What the filter accepts in between ends the row. While there is a doubt, the
vehicle may also have begun to turn as it did not before: until something is accepted again, or the doubts disagree with each other,
predictions are as unsure as that of any vehicle.
"""

from functools import partial
from math import isfinite, nan, sqrt
from typing import Final, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.chi_square import chi_square_limit
from rtkmesh.attitude.filter_options import FilterOptions, Outcome, Trust, Update, Why
from rtkmesh.attitude.innovation import Innovation, Measurement
from rtkmesh.attitude.rotation import rotation_of, vector_of
from rtkmesh.attitude.timeline import Timed, Timeline
from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.time import GpsTime

Vector = NDArray[np.float64]

_AGREEING_SIGMAS: Final = 4.0
_GYRO_FALSE_ALARM: Final = 1e-6


class Measured(Timed, Protocol):
    """A state that knows when it was last measured."""

    @property
    def measured_s(self) -> float:
        """When a measurement of the rotation was last used."""
        ...


S = TypeVar("S", bound=Measured)


class Model(Protocol[S]):
    """The states of a filter and what happens to them. Times are on the filter's own scale (s)."""

    def started(self, measurement: Measurement, time_s: float) -> S | None:
        """Return a state of which nothing is known but what the measurement does not see; None if it cannot start one."""
        ...

    def propagated(self, state: S, time_s: float) -> S:
        """Return the state at a later time."""
        ...

    def moved_to(self, state: S, time_s: float) -> S:
        """Return the state at a time however far away."""
        ...

    def innovation(self, state: S, measurement: Measurement) -> Innovation | None:
        """Return what a measurement says against the state."""
        ...

    def chi_square(self, state: S, innovation: Innovation) -> float:
        """Return the innovation's square in units of its covariance."""
        ...

    def corrected(self, state: S, innovation: Innovation) -> S:
        """Return the state after a measurement."""
        ...

    def restarted(self, state: S, innovation: Innovation, drift_ned_radps: Vector, *, bias: bool) -> S:
        """Return the state made to agree with a measurement, its rate changed by a drift; ``bias``: its gyro's is in doubt, too."""
        ...

    def gyro_chi_square(self, state: S, rate_body_radps: Vector, sigma_radps: float) -> tuple[float, int]:
        """Return how far a gyro's sample is beyond what any vehicle does, and the degrees of freedom."""
        ...

    def with_gyro(self, state: S, rate_body_radps: Vector, sigma_radps: float) -> S:
        """Return the state after a gyro's sample."""
        ...

    def reopened(self, state: S) -> S:
        """Return the state with its rate as unsure as at the start."""
        ...

    def doubted(self, state: S) -> S:
        """Return the state of a vehicle that may have begun to turn in a way that it did not before."""
        ...


class Keeper(Generic[S]):
    """The state of a filter along time. ``resets`` counts restarts after the first start."""

    def __init__(self, model: Model[S], options: FilterOptions) -> None:
        self.resets = 0
        self._model, self._options = model, options
        self._limits = [chi_square_limit(options.false_alarm, degrees) for degrees in range(4)]
        self._gyro_limits = [chi_square_limit(_GYRO_FALSE_ALARM, degrees) for degrees in range(4)]
        self._origin: GpsTime | None = None
        self._timeline: Timeline[S] | None = None
        self._doubts = Doubts(options)
        self._gyro_doubts = 0
        self._late, self._late_s = 0, -np.inf

    def state_at(self, time: GpsTime) -> tuple[S | None, float, Why]:
        """Return the last state not after a time, as it is to be predicted from; the time on its scale (s), and why there is none."""
        state, time_s, why = self._last(time)
        return self._model.doubted(state) if state is not None and self._doubts.since(time_s) else state, time_s, why

    def _last(self, time: GpsTime) -> tuple[S | None, float, Why]:
        if self._timeline is None:
            return None, nan, Why.NOT_ALIGNED
        if not isfinite(time.tow_s):
            return None, nan, Why.INVALID
        time_s = self._seconds(time)
        state = self._timeline.before(time_s)
        return state, time_s, Why.LATE if state is None else Why.OK

    def measure(self, time: GpsTime, measurement: Measurement, trust: Trust) -> Update:
        """Take a measurement at its own time."""
        why = self._objection(time, measurement, trust)
        if why is not Why.OK:
            return Update(Outcome.REFUSED, why)
        time_s = self._seconds(time)
        if self._timeline is None:
            return self._start(time_s, measurement)
        newest = self._timeline.newest
        if time_s - newest.measured_s > self._options.max_coast_s:
            return self._restart(self._model.moved_to(newest, time_s), measurement, Why.GAP)
        before = self._timeline.before(time_s)
        if before is None:
            return self._too_late(time_s, measurement, trust)
        self._late = 0
        return self._judged(before, time_s, measurement, trust)

    def gyro(self, time: GpsTime, rate_body_radps: Vector, sigma_radps: float) -> Update:
        """Take a sample of a gyro at its own time; that it is finite is known."""
        if self._timeline is None:
            return Update(Outcome.REFUSED, Why.NOT_ALIGNED)
        before, time_s, why = self._last(time)
        if before is None:
            return Update(Outcome.REFUSED, why)
        if time_s - before.measured_s > self._options.max_coast_s:
            return Update(Outcome.REFUSED, Why.GAP)
        state = self._model.propagated(before, time_s)
        chi_square, degrees = self._model.gyro_chi_square(state, rate_body_radps, sigma_radps)
        self._gyro_doubts = self._gyro_doubts + 1 if chi_square > self._gyro_limits[degrees] else 0
        if 0 < self._gyro_doubts < self._options.persistence:
            return Update(Outcome.GATED, Why.INNOVATION, chi_square=chi_square, degrees=degrees)
        opened = self._gyro_doubts > 0  # it does turn that fast
        step = partial(self._turned, time_s=time_s, rate_body_radps=rate_body_radps, sigma_radps=sigma_radps, opened=opened)
        self._gyro_doubts = 0
        self._timeline.insert(step(state), step)
        return Update(Outcome.ACCEPTED, chi_square=chi_square, degrees=degrees)

    def _seconds(self, time: GpsTime) -> float:
        if self._origin is None:
            self._origin = time
        return time - self._origin

    def _objection(self, time: GpsTime, measurement: Measurement, trust: Trust) -> Why:
        """Return what speaks against a measurement before anything is computed with it."""
        sigma_rad = measurement.sigma_rad
        if not (isfinite(time.tow_s) and isfinite(sigma_rad)):
            return Why.INVALID
        if not (trust.fixed or self._options.accept_float):
            return Why.NOT_FIXED
        if trust.integrity is Integrity.FAILED or (trust.integrity is not Integrity.OK and not self._options.accept_unchecked):
            return Why.INTEGRITY
        return Why.SIGMA if sigma_rad > self._options.max_measured_sigma_rad else Why.OK

    def _start(self, time_s: float, measurement: Measurement) -> Update:
        state = self._model.started(measurement, time_s)
        innovation = None if state is None else self._model.innovation(state, measurement)
        if state is None or innovation is None:
            self._origin = None
            return Update(Outcome.REFUSED, Why.NOT_ALIGNED if state is None else Why.VERTICAL)
        self._timeline = Timeline(self._model.restarted(state, innovation, np.zeros(3), bias=True), self._options.history_s)
        return Update(Outcome.STARTED)

    def _judged(self, before: S, time_s: float, measurement: Measurement, trust: Trust) -> Update:
        assert self._timeline is not None
        doubted = self._doubts.since(time_s)
        state = self._model.propagated(self._model.doubted(before) if doubted else before, time_s)
        innovation = self._model.innovation(state, measurement)
        if innovation is None:
            return Update(Outcome.REFUSED, Why.VERTICAL)
        chi_square, degrees = self._model.chi_square(state, innovation), len(innovation.value)
        if not chi_square <= self._limits[degrees]:
            if trust.may_reset and self._doubts.enough(innovation, time_s):
                return self._restart(state, measurement, Why.INNOVATION, chi_square)
            return Update(Outcome.GATED, Why.INNOVATION, chi_square=chi_square, degrees=degrees)
        if trust.may_reset:  # what may not overrule the filter does not speak for it, either
            self._doubts.clear()
        step = partial(self._applied, time_s=time_s, measurement=measurement, doubted=doubted)
        self._timeline.insert(self._with(state, innovation), step)
        return Update(Outcome.ACCEPTED, chi_square=chi_square, degrees=degrees)

    def _too_late(self, time_s: float, measurement: Measurement, trust: Trust) -> Update:
        """Refuse what is older than the history; a row of them in order says that time itself went back."""
        assert self._timeline is not None
        self._late = self._late + 1 if time_s > self._late_s and trust.may_reset else 0
        self._late_s = time_s
        if self._late < self._options.persistence:
            return Update(Outcome.REFUSED, Why.LATE)
        return self._restart(self._model.moved_to(self._timeline.newest, time_s), measurement, Why.LATE)

    def _restart(self, state: S, measurement: Measurement, why: Why, chi_square: float = nan) -> Update:
        innovation = self._model.innovation(state, measurement)
        if innovation is None:
            return Update(Outcome.REFUSED, Why.VERTICAL)
        doubted = why is Why.INNOVATION
        drift = self._doubts.drift_ned_radps if doubted else np.zeros(3)
        self._timeline = Timeline(self._model.restarted(state, innovation, drift, bias=doubted), self._options.history_s)
        self._doubts.clear()
        self._late, self._late_s = 0, -np.inf
        self.resets += 1
        jump_rad = float(np.linalg.norm(innovation.turn_ned))
        return Update(Outcome.RESET, why, jump_rad, chi_square, len(innovation.value))

    def _applied(self, state: S, time_s: float, measurement: Measurement, *, doubted: bool) -> S:
        state = self._model.propagated(self._model.doubted(state) if doubted else state, time_s)
        innovation = self._model.innovation(state, measurement)
        return state if innovation is None else self._with(state, innovation)

    def _with(self, state: S, innovation: Innovation) -> S:
        """Correct a state, with the weight of errors that hang together: n of them are worth fewer than n."""
        since, correlation_s = state.time_s - state.measured_s, self._options.correlation_s
        if correlation_s > 0.0:
            rho = float(np.exp(-max(since, 1e-3) / correlation_s))
            innovation = innovation.scaled((1.0 + rho) / (1.0 - rho))
        return self._model.corrected(state, innovation)

    def _turned(self, state: S, time_s: float, rate_body_radps: Vector, sigma_radps: float, *, opened: bool) -> S:
        state = self._model.propagated(state, time_s)
        return self._model.with_gyro(self._model.reopened(state) if opened else state, rate_body_radps, sigma_radps)


class Doubts:
    """Gated measurements in a row, and whether they agree with each other: off by the same turn, or by one that grows steadily."""

    def __init__(self, options: FilterOptions) -> None:
        self._options = options
        self._count, self._time_s, self._wild = 0, 0.0, False
        self._turn, self._variance, self._drift = np.zeros(3), 0.0, np.zeros(3)

    def clear(self) -> None:
        """Forget them: the filter and a measurement agree."""
        self._count, self._wild = 0, False

    def since(self, time_s: float) -> bool:
        """Return whether the newest measurement before a time was gated, and may be right."""
        return self._count > 0 and not self._wild and time_s >= self._time_s

    @property
    def drift_ned_radps(self) -> Vector:
        """By how much the filter's rate is wrong, as they show it; 0 when not clearly more than it may be."""
        return self._drift if float(np.linalg.norm(self._drift)) > self._options.rate_sigma_radps else np.zeros(3)

    def enough(self, innovation: Innovation, time_s: float) -> bool:
        """Count one more, and return whether they overrule the filter."""
        variance, since_s = float(np.trace(innovation.noise)), time_s - self._time_s
        if self._count == 0 or since_s <= 0.0:
            self._count, self._drift = 1, np.zeros(3)
        else:
            growth = vector_of(rotation_of(innovation.turn_ned) @ rotation_of(self._turn).T)
            agrees = self._count == 1 or self._steady(growth, variance, since_s)
            self._count, self._wild = (self._count + 1 if agrees else 2), not agrees
            self._drift = growth / since_s
        self._turn, self._variance, self._time_s = innovation.turn_ned, variance, time_s
        return self._count >= self._options.persistence

    def _steady(self, growth: Vector, variance: float, since_s: float) -> bool:
        """Whether the turn grew as before, but for the noise of three measurements and for a change of the rate."""
        allowed = _AGREEING_SIGMAS * sqrt(3.0 * (variance + self._variance)) + self._options.rate_sigma_radps * since_s
        return float(np.linalg.norm(growth - self._drift * since_s)) <= allowed
