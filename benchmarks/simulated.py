"""A simulated run from truth to score: receivers observe, a live ``Session`` solves their epochs, the truth judges.

Observations go into the session as they are, without their encoding: bytes are tested elsewhere. The session runs as it does live, on a
clock that the run advances: what arrives late is late.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import pi, radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.ephemeris import Ephemeris, KlobucharParameters, ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.classes import F9P, SURVEY
from rtkmesh.simulation.environment import Window
from rtkmesh.simulation.faults import Disturbance, disturbed, with_orbit_error
from rtkmesh.simulation.receiver import Observed, Receiver, ReceiverOptions
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, absolute_s, broadcast
from rtkmesh.simulation.surroundings import Surroundings
from rtkmesh.simulation.trajectories import AntennaPath, Pose, Site, Trajectory, driving

Vector = NDArray[np.float64]
Offset = tuple[float, float, float]
Arrivals = Callable[[int], Sequence[int]]
Sent = tuple[float, Ephemeris]  # an ephemeris and the second of the run in which it arrives
Navigation = Callable[[int, GpsTime, int], Iterable[Sent]]  # of a satellite, of a run that begins then and lasts so many seconds
Faults = Callable[[np.random.Generator, Sequence[Observed], Sequence[Observed]], tuple[list[Disturbance], list[Disturbance]]]

WRONG_M: Final = 0.15
ENOUGH_SATELLITES: Final = 5  # with fewer tracked by the rover nobody can fix, and the epoch is not counted as a chance
_BASE_DELAY_S: Final = 0.15  # of a base epoch behind the rover's, as over a radio
_WAIT_S: Final = 0.9
_NEVER_AGAIN_S: Final = 1e9
_FIRST: Final = GpsTime(2445, 0.0)
_SPEEDS_UP_S: Final = 4.0
_WEEK_S: Final = 604800
_SLOPE_M: Final = 0.02  # sigma of GLONASS delays per channel between receivers of two makes; our choice
# Sigma of what those of the two bands differ by. Delays of one origin are alike on both in metres (Sleewaegen et al. 2012, Inside GNSS
# 7(3):52-61); recorded pairs differ by 0.4 and 1.2 mm.
_SLOPES_APART_M: Final = 0.003


def known_before(satellite: int, start: GpsTime, seconds: int) -> Iterator[Sent]:
    """Yield the ephemerides that a satellite broadcasts at the start and at the end of a run, both known before it."""
    for time in (start, start + float(seconds)):
        yield 0.0, broadcast(satellite, time)


def in_order(k: int) -> Sequence[int]:
    """Let everything arrive when it should."""
    return (k,)


@dataclass(frozen=True, slots=True)
class Outage:
    """Seconds of the run in which the rover's sky is hidden below an elevation (all of it by default)."""

    start_s: float
    duration_s: float
    below_rad: float = pi


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """What is simulated and how it is solved.

    The rover has ``rate_hz`` epochs in each of its ``seconds``, the base ``base_rate_hz`` (0: as many). ``base_enu_m``: place of the base
    at the site or, with ``base_moves``, its lever arm on the rover's vehicle. ``arrivals(k)``: the base epochs of which seconds reach the
    solver in second k; ``rover_arrivals(k)``: which epochs of the rover when its epoch k should. From second ``restart_at`` on the base is
    dead for ``restart_gap`` seconds and comes back cold, from ``rover_restart_at`` on the rover. From second ``shift_at`` on the base tells
    a position that is ``shift_enu_m`` off. ``told_restarts``: the session is restarted at the end of every outage, as by the command.
    ``jumps_at``: seconds at which the clocks of rover and base jump by a millisecond (None: when they would). ``crosses``: in this second
    of the run is a multiple of so many seconds of the week (None: a run begins at any time). ``navigation``: which ephemerides arrive when.
    The vehicle stands for ``stands_s`` before it moves.
    """

    seconds: int
    rate_hz: int = 1
    base_rate_hz: int = 0
    options: RtkOptions = field(default_factory=RtkOptions)
    trajectory: Trajectory = driving
    rover: ReceiverOptions = F9P
    base: ReceiverOptions = SURVEY
    base_enu_m: Offset = (-420.0, 260.0, 12.0)
    base_moves: bool = False
    outages: tuple[Outage, ...] = ()
    surroundings: Surroundings | None = None
    activity: float = 1.0
    faults: Faults | None = None
    arrivals: Arrivals = in_order
    rover_arrivals: Arrivals = in_order
    rover_restart_at: int | None = None
    restart_at: int | None = None
    restart_gap: int = 10
    shift_at: int | None = None
    shift_enu_m: Offset = (0.0, 0.0, 0.0)
    told_restarts: bool = False
    jumps_at: tuple[int | None, int | None] = (None, None)
    crosses: tuple[int, int] | None = None
    stands_s: float = 0.0
    navigation: Navigation = known_before

    @property
    def epochs(self) -> int:
        """Epochs of the rover."""
        return self.seconds * self.rate_hz

    @property
    def base_hz(self) -> int:
        """Epochs of the base in a second."""
        return self.base_rate_hz or self.rate_hz


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """The observations of a run and its truth.

    ``baseline_ecef_m`` (epochs, 3) is rover minus base: where the rover was when it measured or, of a moving base, both at the instant that
    the rover's tag names, as solutions of moving bases are.
    """

    setup: Setup
    seed: int
    start: GpsTime
    site: Site
    rover: list[Observed]
    base: list[Observed | None]
    baseline_ecef_m: Vector
    base_ecef_m: Vector
    rover_epochs: list[Epoch]
    base_epochs: list[Epoch | None]
    disturbances: list[tuple[str, Disturbance]]


def slopes_of_two_makes_m(rng: np.random.Generator) -> tuple[float, float]:
    """Return GLONASS delays per channel (m), on either band, of a receiver against one of another make.

    The second is of a generator of its own: runs are what they were when there was one for both.
    """
    first_m = _SLOPE_M * float(rng.standard_normal())
    return first_m, first_m + _SLOPES_APART_M * float(rng.spawn(1)[0].standard_normal())


def simulate(setup: Setup, rng: np.random.Generator) -> Simulated:
    """Return a run at a random place and time of the week; every random number is ``rng``'s."""
    seed = int(rng.integers(2**31))
    start = _start(setup, _FIRST + float(rng.integers(_WEEK_S)))
    site = Site(radians(float(rng.uniform(-60.0, 60.0))), radians(float(rng.uniform(-180.0, 180.0))), float(rng.uniform(0.0, 500.0)))
    delay_s = absolute_s(start) - float(rng.uniform(0.0, 300.0))

    def begun(time_s: float) -> Pose:
        return setup.trajectory(_in_motion_s(time_s, absolute_s(start), setup.stands_s) - delay_s)

    windows = tuple(Window(_NEVER_AGAIN_S, absolute_s(start) + o.start_s, o.duration_s, o.below_rad) for o in setup.outages)
    rover_path = AntennaPath(site, begun, (0.0, 0.0, -1.5))
    base_path = AntennaPath(site, begun if setup.base_moves else None, setup.base_enu_m)
    on_vehicle = windows, setup.surroundings
    seen = [_or_silent(o) for o in _observed(setup, "rover", rover_path, seed, start, on_vehicle)]
    around_base = on_vehicle if setup.base_moves else ((), None)
    base = [None if dead else o for o, dead in _observed(setup, "base", base_path, seed, start, around_base)]
    base_ecef_m = base_path.position_ecef_m(absolute_s(start))
    if setup.base_moves:
        tags_s = [absolute_s(o.epoch.time) for o in seen]
        baseline_ecef_m = np.array([rover_path.position_ecef_m(t) - base_path.position_ecef_m(t) for t in tags_s])
    else:
        baseline_ecef_m = np.array([o.position_ecef_m for o in seen]) - base_ecef_m
    present = [b for b in base[:: setup.base_hz] if b is not None]  # faults are told by seconds
    on_rover, on_base = setup.faults(rng, seen[:: setup.rate_hz], present) if setup.faults else ([], [])
    return Simulated(
        setup, seed, start, site, seen, base, baseline_ecef_m, base_ecef_m,
        [disturbed(o.epoch, on_rover) for o in seen], [None if b is None else disturbed(b.epoch, on_base) for b in base],
        [*(("rover", d) for d in on_rover), *(("base", d) for d in on_base)],
    )  # fmt: skip


def _in_motion_s(time_s: float, start_s: float, stands_s: float) -> float:
    """Return the time of a vehicle that first stands: it stops, and gathers speed again in _SPEEDS_UP_S."""
    since_s = time_s - start_s - stands_s
    if not stands_s:
        return time_s
    return start_s + (since_s - 0.5 * _SPEEDS_UP_S if since_s >= _SPEEDS_UP_S else 0.5 * max(since_s, 0.0) ** 2 / _SPEEDS_UP_S)


def _start(setup: Setup, drawn: GpsTime) -> GpsTime:
    """Return when a run begins: at a drawn time, or as near to it as lets it cross what it must."""
    if setup.crosses is None:
        return drawn
    at_s, every_s = setup.crosses
    return GpsTime.normalized(drawn.week, -(-drawn.tow_s // every_s) * every_s - at_s)


def _observed(
    setup: Setup, name: str, path: AntennaPath, seed: int, start: GpsTime, around: tuple[tuple[Window, ...], Surroundings | None]
) -> Iterator[tuple[Observed, bool]]:
    """Yield what a receiver observes, with its restart, and whether it is dead then."""
    is_base = name == "base"
    options, rate_hz = (setup.base, setup.base_hz) if is_base else (setup.rover, setup.rate_hz)
    jump, restart_at = setup.jumps_at[is_base], setup.restart_at if is_base else setup.rover_restart_at
    options = options if jump is None else replace(options, jumps_at_s=absolute_s(start) + jump)
    receiver = Receiver(name, path, seed, options, *around, setup.activity)
    for k in range(setup.seconds * rate_hz):
        time_s = k / rate_hz
        if restart_at is not None and time_s == restart_at + setup.restart_gap:
            receiver = Receiver(f"{name}, restarted", path, seed, replace(options, warm=False), *around, setup.activity)
        yield receiver.observe(start + time_s), restart_at is not None and restart_at <= time_s < restart_at + setup.restart_gap


def _or_silent(seen: tuple[Observed, bool]) -> Observed:
    """Return what a rover observed; nothing but where it is while it is dead."""
    observed, dead = seen
    if not dead:
        return observed
    none = observed.epoch.take(np.zeros(0, np.intp))
    columns = (getattr(observed, name)[:0] for name in ("half_cycle_subtracted", "azimuth_rad", "elevation_rad"))
    half_cycles, azimuth_rad, elevation_rad = columns
    return replace(observed, epoch=none, half_cycle_subtracted=half_cycles, azimuth_rad=azimuth_rad, elevation_rad=elevation_rad)


def solve(run: Simulated) -> list[Solution | None]:
    """Return the solution of every rover epoch (None: none came)."""
    return by_epoch(run, solutions_of(run))


def by_epoch(run: Simulated, solutions: Iterable[Solution]) -> list[Solution | None]:
    """Return solutions in the order of the rover's epochs (None: none came)."""
    place = {epoch.time: k for k, epoch in enumerate(run.rover_epochs)}
    out: list[Solution | None] = [None] * run.setup.epochs
    for solution in solutions:
        out[place[solution.time]] = solution
    return out


def solutions_of(run: Simulated) -> Iterator[Solution]:
    """Yield the solutions as the session gives them."""
    setup = run.setup
    session = Session(SessionOptions(setup.options, pairing_for(setup.options, replay=False, maximum_wait_s=_WAIT_S)))
    for now_s, event in sorted(_events(run, session), key=lambda timed: timed[0]):
        if event is not None:
            event()
            continue
        yield from session.solutions(now_s)


def _events(run: Simulated, session: Session) -> Iterator[tuple[float, Callable[[], None] | None]]:
    """Yield when what is done with a session, None where it is asked for solutions; of equal instants what is yielded first comes first."""
    setup = run.setup
    for now_s, message in _navigation(run):
        yield now_s, partial(session.feed, Source.NAVIGATION, message)
    for outage in setup.outages if setup.told_restarts else ():
        yield float(round(outage.start_s + outage.duration_s)), session.restart
    for k in range(setup.epochs):
        for epoch in _sent_by_rover(run, k):
            yield k / setup.rate_hz, partial(session.feed, Source.ROVER, epoch, k / setup.rate_hz)
    for k in range(len(run.base_epochs)):
        now_s = k / setup.base_hz + _BASE_DELAY_S
        yield now_s, partial(session.feed, Source.BASE, _told_station(run, k // setup.base_hz), now_s)
        for epoch in _arriving(run, k):
            yield now_s, partial(session.feed, Source.BASE, epoch, now_s)
    for k in range(setup.epochs):
        for wait_s in (_BASE_DELAY_S, _WAIT_S + 0.05):
            yield k / setup.rate_hz + wait_s, None


def _told_station(run: Simulated, second: int) -> ReferenceStation:
    """Return where the base says that it is."""
    shifted = run.setup.shift_at is not None and second >= run.setup.shift_at
    shift_m = run.site.ecef_from_enu() @ np.array(run.setup.shift_enu_m) if shifted else np.zeros(3)
    x, y, z = (run.base_ecef_m + shift_m).tolist()
    return ReferenceStation(1, (x, y, z))


def _arriving(run: Simulated, k: int) -> Iterator[Epoch]:
    """Yield the base epochs that arrive when its epoch k would, if none were late or lost."""
    second, within = divmod(k, run.setup.base_hz)
    for told in run.setup.arrivals(second):
        place = told * run.setup.base_hz + within
        epoch = run.base_epochs[place] if 0 <= place < len(run.base_epochs) else None
        if epoch is not None:
            yield epoch


def _sent_by_rover(run: Simulated, k: int) -> Iterator[Epoch]:
    """Yield the rover's epochs that arrive when its epoch k should; a receiver that is dead sends none."""
    setup, at = run.setup, run.setup.rover_restart_at
    for place in setup.rover_arrivals(k):
        dead = at is not None and at <= place / setup.rate_hz < at + setup.restart_gap
        if 0 <= place < setup.epochs and not dead:
            yield run.rover_epochs[place]


def _navigation(run: Simulated) -> Iterator[tuple[float, Ephemeris | KlobucharParameters]]:
    """Yield the ephemerides of the run, as wrong as broadcast ones are, and the ionosphere's parameters."""
    for satellite in SATELLITES.tolist():
        for time_s, ephemeris in run.setup.navigation(satellite, run.start, run.setup.seconds):
            yield time_s, with_orbit_error(ephemeris, run.seed)
    yield 0.0, KLOBUCHAR


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What a run's solutions are worth, per epoch: status (0: none), error (epochs, 3; ENU, m), normalised squared error, chances, and the
    published probability of being wrong.
    """

    status: NDArray[np.int64]
    error_enu_m: Vector
    normalised: Vector
    possible: NDArray[np.bool_]
    doubt: Vector

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Epochs that claim a fix."""
        return self.status == int(Status.FIX)

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """Fixes that are off by more than WRONG_M in 3D."""
        return self.fixed & (np.linalg.norm(self.error_enu_m, axis=1) > WRONG_M)


def judge(run: Simulated, solutions: Sequence[Solution | None]) -> Judged:
    """Hold solutions against the truth. Of a base that stands the rover's position is judged, relative to what the base told."""
    setup, turn = run.setup, run.site.ecef_from_enu()

    def compared(k: int, solution: Solution) -> tuple[Vector, Vector]:
        relative, cov = solution.baseline_ecef_m, solution.baseline_cov_ecef_m2
        if setup.options.mode is not Mode.MOVING_BASE:
            shifted = setup.shift_at is not None and k >= setup.shift_at * setup.rate_hz
            told = run.base_ecef_m + (turn @ np.array(setup.shift_enu_m) if shifted else 0.0)
            relative, cov = solution.position_ecef_m - told, solution.position_cov_ecef_m2
        return relative - run.baseline_ecef_m[k], cov

    possible = np.array([len(np.unique(o.epoch.satellite)) >= ENOUGH_SATELLITES for o in run.rover])
    return held_against(compared, solutions, turn, possible)


def held_against(
    compared: Callable[[int, Solution], tuple[Vector, Vector]], solutions: Sequence[Solution | None], ecef_from_enu: Vector,
    possible: NDArray[np.bool_],
) -> Judged:  # fmt: skip
    """Return what solutions are worth, one per epoch; ``compared`` gives the error of that of an epoch (ECEF, m) and its covariance."""
    n = len(solutions)
    status, error, normalised, doubt = np.zeros(n, np.int64), np.full((n, 3), np.nan), np.full(n, np.nan), np.ones(n)
    for k, solution in enumerate(solutions):
        if solution is None:
            continue
        status[k], doubt[k] = int(solution.status), 1.0 - solution.fix_probability
        difference, cov = compared(k, solution)
        error[k] = ecef_from_enu.T @ difference
        if np.isfinite(difference).all() and np.isfinite(cov).all():
            normalised[k] = difference @ np.linalg.solve(cov, difference) / 3.0
    return Judged(status, error, normalised, possible, doubt)
