"""The families of the campaign: what each run of a family is, drawn from the run's own random numbers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import cos, hypot, inf, isfinite, pi, radians, sin
from typing import Final

import numpy as np

from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.simulation.classes import F9P, M8, SURVEY, moving
from rtkmesh.simulation.faults import Disturbance
from rtkmesh.simulation.receiver import Observed, ReceiverOptions
from rtkmesh.simulation.sky import absolute_s
from rtkmesh.simulation.surroundings import Surroundings, city, forest
from rtkmesh.simulation.trajectories import Trajectory, boat, driving, static, streets, walking
from simulated import Arrivals, Faults, Offset, Outage, Setup, slopes_of_two_makes_m

Random = np.random.Generator

_OPEN: Final = 90  # seconds of a run
_LONG: Final = 150
_SETTLED_S: Final = 20  # faults come once the solver has begun
# Motions, and how long (s) multipath hangs together on them at most: for ever, or as the vehicle moves on. A walk with an F9P shows 11 s,
# a machine in a forest 24; the others are our choice: codes of u-blox receivers are smoothed for as long as that whatever the motion.
MOTIONS: Final[Mapping[str, tuple[Trajectory, float]]] = {
    "static": (static, inf), "driving": (driving, 8.0), "boat": (boat, 15.0), "walking": (walking, 11.0),
}  # fmt: skip
BASE: Final = replace(SURVEY, steered=True)
_EARTH_M: Final = 6.371e6
# Which systems rover and base have in common, and how often: old bases send GPS alone or GPS and GLONASS, new ones all.
_SYSTEMS: Final = ("G", "GR", "GE", "GREC")
_SHARES: Final = (0.15, 0.25, 0.2, 0.4)


@dataclass(frozen=True, slots=True)
class Family:
    """A kind of run."""

    name: str
    title: str
    make: Callable[[Random], Setup]


def base_place(rng: Random, shortest_m: float = 50.0, longest_m: float = 5000.0) -> Offset:
    """Return a place of a base, all orders of distance alike; it stands on the round earth."""
    distance_m = float(np.exp(rng.uniform(np.log(shortest_m), np.log(longest_m))))
    azimuth = float(rng.uniform(0.0, 2.0 * pi))
    up_m = float(rng.normal(0.0, min(10.0, 0.05 * distance_m))) - distance_m**2 / (2.0 * _EARTH_M)
    return distance_m * sin(azimuth), distance_m * cos(azimuth), up_m


def in_motion(receiver: ReceiverOptions, multipath_s: float) -> ReceiverOptions:
    """Return a receiver whose multipath hangs together for so long (s; infinite: it stands)."""
    return replace(receiver, signals=moving(receiver.signals, multipath_s)) if isfinite(multipath_s) else receiver


def _open(
    rng: Random, rover: ReceiverOptions, *, frequencies: int = 2, seconds: int = _OPEN, motion: tuple[Trajectory, float] | None = None
) -> Setup:
    """Return a run under an open sky, 50 m to 5 km from the base; ``motion``: one of MOTIONS by default."""
    options = RtkOptions(frequencies=frequencies)
    common = "".join(s for s in str(rng.choice(_SYSTEMS, p=_SHARES)) if s in rover.systems)
    trajectory, multipath_s = motion or list(MOTIONS.values())[int(rng.integers(len(MOTIONS)))]
    receiver = in_motion(replace(rover, systems=common, frequencies=frequencies), multipath_s)
    place = base_place(rng)
    base = replace(BASE, signals=BASE.signals._replace(glonass_slopes_m=slopes_of_two_makes_m(rng)))
    return Setup(seconds=seconds, options=options, trajectory=trajectory, rover=receiver, base=base, base_enu_m=place)


def _open_dual(rng: Random) -> Setup:
    return _open(rng, F9P if rng.random() < 0.5 else SURVEY)


def houses(rng: Random) -> Surroundings:
    """Return streets of 20 m between houses of 8 to 40 m."""
    return city(int(rng.integers(2**31)), float(rng.uniform(8.0, 40.0)))


def trees(rng: Random) -> Surroundings:
    """Return a stand of trees, from light to dense."""
    return forest(int(rng.integers(2**31)), float(rng.uniform(0.2, 1.0)))


def in_streets(receiver: ReceiverOptions) -> ReceiverOptions:
    """Return a receiver that slips where signals are weak and misses some of it."""
    return replace(receiver, signals=receiver.signals._replace(weak_slips_per_hour=60.0, untold_share=0.05))


def in_forest(receiver: ReceiverOptions) -> ReceiverOptions:
    """Return a receiver with fast fading, many slips, half cycles."""
    noise = receiver.signals._replace(
        fading_sigma_db=3.0, fading_time_s=1.0, slips_per_hour=20.0, weak_slips_per_hour=120.0, untold_share=0.05,
        half_cycle_share=0.5,
    )  # fmt: skip
    return replace(receiver, signals=noise)


def _urban(rng: Random) -> Setup:
    """A car in streets."""
    around = houses(rng)
    run = _open(rng, in_streets(F9P), seconds=_LONG, motion=(streets, 8.0))
    return replace(run, surroundings=around, base_enu_m=base_place(rng, 300.0, 3000.0))


def _forest(rng: Random) -> Setup:
    """A walk under trees."""
    around = trees(rng)
    return replace(_open(rng, in_forest(F9P), seconds=_LONG, motion=(walking, 11.0)), surroundings=around)


# --- faults of single satellites ---


def _signals_in_view(observed: Observed, lowest_rad: float = radians(20.0)) -> list[tuple[int, int]]:
    """Return the (satellite, signal) of what stands high enough to be used."""
    high = observed.elevation_rad > lowest_rad
    return list(zip(observed.epoch.satellite[high].tolist(), observed.epoch.signal[high].tolist(), strict=True))


def slips_on(rng: Random, observed: Sequence[Observed], unit_cyc: float = 1.0) -> list[Disturbance]:
    """Return up to four slips of 1 to 3 cycles, or of so many parts of one, that nobody tells, on one or all bands of a satellite each."""
    found: list[Disturbance] = []
    for _ in range(int(rng.integers(1, 5))):
        at = observed[int(rng.integers(_SETTLED_S, len(observed) - 5))]
        rows = _signals_in_view(at)
        if not rows:
            continue
        satellite, signal = rows[int(rng.integers(len(rows)))]
        size = unit_cyc * float(rng.integers(1, 4)) * (1.0 if rng.random() < 0.5 else -1.0)
        both = rng.random() < 0.5
        found.append(Disturbance(satellite, None if both else signal, absolute_s(at.epoch.time), phase_cyc=size))
    return found


def rover_slips(rng: Random, rover: Sequence[Observed], _base: Sequence[Observed]) -> tuple[list[Disturbance], list[Disturbance]]:
    return slips_on(rng, rover), []


def base_slips(rng: Random, _rover: Sequence[Observed], base: Sequence[Observed]) -> tuple[list[Disturbance], list[Disturbance]]:
    return [], slips_on(rng, base)


def bad_codes(count: int, lowest_m: float, highest_m: float, lowest_mps: float = 0.0, highest_mps: float = 0.0) -> Faults:
    """Return faults of ``count`` satellites' codes at once, of all bands: a step, a ramp; in half of the runs from the first epoch on."""

    def faults(rng: Random, rover: Sequence[Observed], _base: Sequence[Observed]) -> tuple[list[Disturbance], list[Disturbance]]:
        at = rover[0 if rng.random() < 0.5 else int(rng.integers(_SETTLED_S, len(rover) // 2))]
        satellites = sorted({satellite for satellite, _ in _signals_in_view(at)}) or [0]
        bad = rng.choice(satellites, min(count, len(satellites)), replace=False).tolist()
        start_s = absolute_s(at.epoch.time)
        signs = [1.0 if rng.random() < 0.5 else -1.0 for _ in bad]
        return [
            Disturbance(
                satellite, None, start_s, start_s + 60.0, code_m=sign * float(rng.uniform(lowest_m, highest_m)),
                code_rate_mps=sign * float(rng.uniform(lowest_mps, highest_mps)),
            )
            for satellite, sign in zip(bad, signs, strict=True)
        ], []  # fmt: skip

    return faults


def _with_bad_codes(faults: Faults) -> Callable[[Random], Setup]:
    """Return the maker of runs with these faults; half of them on one band."""
    return lambda rng: replace(_open(rng, F9P, frequencies=1 + int(rng.integers(2))), faults=faults)


# --- outages ---


def _tunnel(rng: Random) -> Setup:
    """A drive with two tunnels of 3 to 30 s, a bridge of a second, and a cutting."""
    outages = (
        Outage(float(rng.integers(20, 40)), float(rng.integers(3, 31))),
        Outage(float(rng.integers(75, 85)), 1.2),
        Outage(float(rng.integers(88, 95)), 10.0, radians(35.0)),
        Outage(float(rng.integers(105, 115)), float(rng.integers(3, 16))),
    )
    return replace(_open(rng, F9P, seconds=_LONG, motion=(driving, 8.0)), outages=outages)


def _dive(rng: Random) -> Setup:
    """A boat that dives once for 10 to 120 s and stays up for half a minute after it."""
    length = int(rng.integers(10, 121))
    return replace(_open(rng, F9P, seconds=30 + length + 35, motion=(boat, 15.0)), outages=(Outage(30.0, float(length)),))


# --- faults of the base ---


def late(age: int) -> Arrivals:
    """Return the arrivals of a base whose epochs come so many seconds late."""
    return lambda k: (k - age,)


def thinned(interval: int) -> Arrivals:
    """Return the arrivals of a base that sends every so many seconds."""
    return lambda k: (k,) if k % interval == 0 else ()


def _base_age(rng: Random) -> Setup:
    """Base epochs come 5 to 30 s late, or every 5 to 30 s only."""
    age = int(rng.integers(5, 31))
    arrivals = late(age) if rng.random() < 0.5 else thinned(age)
    return replace(_open(rng, F9P), arrivals=arrivals)


def gaps(rng: Random, seconds: int, latest: int) -> Arrivals:
    """Return the arrivals of a base of whose epochs a third is lost, and one stretch of up to 20 s that begins by ``latest`` (s)."""
    lost = rng.random(seconds) < 1.0 / 3.0
    begin = int(rng.integers(_SETTLED_S, latest))
    lost[begin : begin + int(rng.integers(2, 21))] = True
    return lambda k: () if lost[k] else (k,)


def _base_gaps(rng: Random) -> Setup:
    arrivals = gaps(rng, _OPEN, 60)
    return replace(_open(rng, F9P), arrivals=arrivals)


def shift_enu_m(rng: Random) -> Offset:
    """Return how far another position is that a base tells: 1 cm to 10 m off, as after a new survey."""
    size_m = float(np.exp(rng.uniform(np.log(0.01), np.log(10.0))))
    direction = rng.standard_normal(3)
    east, north, up = (size_m * direction / np.linalg.norm(direction)).tolist()
    return east, north, up


def _shift(rng: Random) -> Setup:
    """The base tells another position from some epoch on."""
    off_m = shift_enu_m(rng)
    return replace(_open(rng, F9P), shift_at=int(rng.integers(_SETTLED_S, 70)), shift_enu_m=off_m)


# --- other geometries ---


def _far(distance_m: float) -> Callable[[Random], Setup]:
    """Return the maker of runs that far from the base; the ionosphere from quiet to active (factor 3)."""

    def make(rng: Random) -> Setup:
        place = base_place(rng, 0.9 * distance_m, 1.1 * distance_m)
        activity = float(rng.uniform(0.5, 3.0))
        rover = F9P if rng.random() < 0.5 else SURVEY
        return replace(_open(rng, rover, seconds=_LONG), base_enu_m=place, activity=activity)

    return make


def _moving_base(rng: Random) -> Setup:
    """Two antennas 0.5 to 2 m apart on a vehicle; half of the solvers know the length."""
    forward, right = float(rng.uniform(0.5, 2.0)), float(rng.uniform(-0.5, 0.5))
    known = rng.random() < 0.5
    options = RtkOptions(mode=Mode.MOVING_BASE, baseline_length_m=hypot(forward, right) if known else None)
    run = _open(rng, F9P, motion=(driving, 8.0) if rng.random() < 0.5 else (boat, 15.0))
    base = replace(run.rover, clock_drift=-1.7e-7)
    return replace(run, base=base, base_moves=True, options=options, base_enu_m=(forward, right, -1.5))


FAMILIES: Final = (
    Family("open", "open sky, two bands, F9P or survey grade", _open_dual),
    Family("open_survey_l1", "open sky, one band, survey grade", lambda rng: _open(rng, SURVEY, frequencies=1)),
    Family("open_f9p_l1", "open sky, one band, F9P class", lambda rng: _open(rng, F9P, frequencies=1)),
    Family("open_m8_l1", "open sky, one band, M8 class (G, R)", lambda rng: _open(rng, M8, frequencies=1, seconds=_LONG)),
    Family("urban", "streets between houses", _urban),
    Family("forest", "walk under trees", _forest),
    Family("slips", "untold slips of 1 to 3 cycles, rover", lambda rng: replace(_open(rng, F9P), faults=rover_slips)),
    Family(
        "slips_l1",
        "the same on one band",
        lambda rng: replace(_open(rng, F9P, frequencies=1), faults=rover_slips),
    ),
    Family("base_slips", "untold slips, base", lambda rng: replace(_open(rng, F9P), faults=base_slips)),
    Family("tunnel", "tunnels of 3 to 30 s", _tunnel),
    Family("dive", "dives of 10 to 120 s", _dive),
    Family("dive_told", "the same, session restarted at surfacing", lambda rng: replace(_dive(rng), told_restarts=True)),
    Family("base_age", "base 5 to 30 s old", _base_age),
    Family("base_gaps", "base epochs lost", _base_gaps),
    Family("base_restart", "base dead for 10 s, then cold", lambda rng: replace(_open(rng, F9P), restart_at=int(rng.integers(20, 60)))),
    Family("base_shift", "base tells another position", _shift),
    Family("code_step", "one satellite's codes 30 m off", _with_bad_codes(bad_codes(1, 30.0, 30.0))),
    Family("code_ramp", "one satellite's codes drift", _with_bad_codes(bad_codes(1, 0.0, 0.0, 0.1, 2.0))),
    Family("two_bad", "two satellites' codes off at once", _with_bad_codes(bad_codes(2, 5.0, 40.0))),
    Family("km7", "7 km", _far(7e3)),
    Family("km10", "10 km", _far(10e3)),
    Family("km35", "35 km", _far(35e3)),
    Family("moving_base", "two antennas on a vehicle", _moving_base),
)


def named(names: str | None) -> list[Family]:
    """Return the families of these names, with commas between, in the order of FAMILIES; all without a name (ValueError: there is none)."""
    wanted = set(names.split(",")) if names else {family.name for family in FAMILIES}
    if unknown := wanted - {family.name for family in FAMILIES}:
        raise ValueError(f"no family {', '.join(sorted(unknown))}; there are {', '.join(family.name for family in FAMILIES)}")
    return [family for family in FAMILIES if family.name in wanted]
