#!/usr/bin/env python3
"""Which faults and surroundings, alone and together, make the engine wrong? The drawn configurations of modes.py, with troubles on top.

  troubles.py [--runs N] [--seed S] [--only FACTOR=LEVEL|LEVEL,...] [--quick] [--json] [--jobs N]
  troubles.py --run SEED:K [--trace [--twin]]        one run again, or its twin

Every run draws a configuration as modes.py does and one to three troubles (TROUBLES, each with its own draws); it is 60 s long. Its twin
is the same without them: same place, time and receivers. Tables and columns as those of modes.py; beside them the right fixes of the twins,
and the runs that never have one though their twin does. Listed with their commands: runs and twins with wrong fixes, runs in which
something is that must never be (exceptions, values that are no numbers, times that do not rise), and runs with far fewer right fixes than
their twins, which troubles may explain.

Vehicles with two antennas stand in streets; where they have no use for what a base says (its place, late epochs), it has gaps.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import radians
from typing import Final

import numpy as np

import kernel_cache  # noqa: F401  first of all
import modes
import scan
from families import (
    MOTIONS,
    Random,
    bad_codes,
    base_slips,
    gaps,
    houses,
    in_forest,
    in_streets,
    late,
    rover_slips,
    shift_enu_m,
    slips_on,
    thinned,
    trees,
)
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import Mode
from rtkmesh.simulation.faults import Disturbance, with_wrong_orbit
from rtkmesh.simulation.receiver import Observed, ReceiverOptions
from rtkmesh.simulation.sky import broadcast
from rtkmesh.simulation.trajectories import streets, walking
from scan import Levels, Scan
from simulated import Arrivals, Faults, Outage, Sent, Setup, known_before

Change = Callable[[Setup, Random], Setup]  # makes a trouble of a run

SECONDS: Final = 60
_EARLIEST, _LATEST = 20, 45  # seconds in which troubles begin
_COUNTS: Final = (0.35, 0.4, 0.25)  # of runs with one, two and three troubles
_OF_TROUBLES: Final = 1  # what is drawn for troubles does not change what is drawn for the configuration
_ISSUES_S: Final = 7200  # GPS satellites change their ephemerides then, and others with them
_WEEK_S: Final = 604800
_BEFORE_S: Final = SECONDS + 30  # so long before it does a run begin that is not to cross such an instant
_COVERED_S: Final = 30.0  # within so long all satellites have told their ephemerides


def _second(rng: Random) -> int:
    return int(rng.integers(_EARLIEST, _LATEST))


def _is_one_vehicle(run: Setup) -> bool:
    """Tell whether rover and base are on one vehicle."""
    return run.options.mode is Mode.MOVING_BASE


# --- where ---


def _streets(run: Setup, rng: Random) -> Setup:
    """Streets; who moves drives, vehicles with two antennas and who stands do so at a crossing."""
    around, trajectory = houses(rng), run.trajectory
    if _is_one_vehicle(run):
        return replace(_standing(run), rover=in_streets(run.rover), base=in_streets(run.base), surroundings=around)
    trajectory = trajectory if trajectory is MOTIONS["static"][0] else streets
    return replace(run, rover=in_streets(run.rover), surroundings=around, trajectory=trajectory)


def _standing(run: Setup) -> Setup:
    return replace(run, trajectory=MOTIONS["static"][0])


def _forest(run: Setup, rng: Random) -> Setup:
    base = in_forest(run.base) if _is_one_vehicle(run) else run.base
    return replace(run, rover=in_forest(run.rover), base=base, surroundings=trees(rng))


def _bridges(run: Setup, rng: Random) -> Setup:
    """Three bridges of 1 to 3 s."""
    return replace(run, outages=tuple(Outage(float(at), float(rng.uniform(1.0, 3.0))) for at in (15, 28, 41)))


def _tunnel(run: Setup, rng: Random) -> Setup:
    return replace(run, outages=(Outage(float(_second(rng)), float(rng.integers(4, 16))),))


def _cutting(run: Setup, rng: Random) -> Setup:
    """Ten seconds in which nothing is seen below 35 degrees."""
    return replace(run, outages=(Outage(float(_second(rng)), 10.0, radians(35.0)),))


def _stands_first(run: Setup, rng: Random) -> Setup:
    """Stand, then move: where the mode lets it."""
    if run.options.mode is Mode.STATIC:
        return run
    trajectory = walking if run.trajectory is MOTIONS["static"][0] else run.trajectory
    return replace(run, trajectory=trajectory, stands_s=float(_second(rng)))


# --- phases and codes ---


def _also(faults: Faults) -> Change:
    """Return what adds faults of single satellites to those that a run has."""

    def change(run: Setup, _rng: Random) -> Setup:
        return replace(run, faults=faults if run.faults is None else partial(_both, run.faults, faults))

    return change


def _both(
    first: Faults, second: Faults, rng: Random, rover: Sequence[Observed], base: Sequence[Observed]
) -> tuple[list[Disturbance], list[Disturbance]]:
    (on_rover, on_base), (also_rover, also_base) = first(rng, rover, base), second(rng, rover, base)
    return [*on_rover, *also_rover], [*on_base, *also_base]


def _halves(rng: Random, rover: Sequence[Observed], _base: Sequence[Observed]) -> tuple[list[Disturbance], list[Disturbance]]:
    """Return half cycles, and multiples of these, that nobody tells and that are gone after 1 to 20 s."""
    return [replace(d, end_s=d.start_s + float(rng.uniform(1.0, 20.0))) for d in slips_on(rng, rover, 0.5)], []


def _slipping(receiver: ReceiverOptions) -> ReceiverOptions:
    """Return a receiver whose signals slip every half a minute, and which tells it."""
    return replace(receiver, signals=receiver.signals._replace(slips_per_hour=120.0, untold_share=0.0))


def _unresolved(run: Setup, rng: Random) -> Setup:
    """A rover that starts cold and resolves half cycles late; half of the arcs are wrong by one until then."""
    noise = run.rover.signals._replace(half_cycle_share=0.5, half_cycle_time_s=float(rng.uniform(5.0, 30.0)), slips_per_hour=60.0)
    return replace(run, rover=replace(run.rover, signals=noise, warm=False))


# --- what the base sends ---


def _swapped(k: int) -> Sequence[int]:
    """Let every odd epoch come before the even one that it follows."""
    return (k, k - 1) if k % 2 else ()


def _twice(k: int) -> Sequence[int]:
    """Let every epoch come, and the last one again."""
    return (k, k - 1, k)


def _arriving(make: Callable[[Random], Arrivals]) -> Change:
    """Return what lets base epochs arrive so; antennas of a vehicle need each other's epoch, and have gaps."""

    def change(run: Setup, rng: Random) -> Setup:
        return _gaps(run, rng) if _is_one_vehicle(run) else replace(run, arrivals=make(rng))

    return change


def _gaps(run: Setup, rng: Random) -> Setup:
    return replace(run, arrivals=gaps(rng, run.seconds, _LATEST))


def _restarting_base(run: Setup, rng: Random) -> Setup:
    return replace(run, restart_at=_second(rng), restart_gap=int(rng.integers(3, 11)))


def _shifted(run: Setup, rng: Random) -> Setup:
    return _gaps(run, rng) if _is_one_vehicle(run) else replace(run, shift_at=_second(rng), shift_enu_m=shift_enu_m(rng))


# --- receivers ---


_OF_BASE: Final = ("base's jumps", "both jump")


def _jumping(*, rover: bool, base: bool) -> Change:
    """Return what lets clocks jump by a millisecond; that of the base is not steered, then."""

    def change(run: Setup, rng: Random) -> Setup:
        rover_at, base_at = _second(rng), _second(rng)
        return replace(run, jumps_at=(rover_at if rover else None, base_at if base else None))

    return change


def _restarting_rover(run: Setup, rng: Random) -> Setup:
    return replace(run, rover_restart_at=_second(rng), restart_gap=int(rng.integers(3, 11)))


# --- ephemerides ---


def _told_late(run: Setup, rng: Random) -> Setup:
    """The ephemeris of every satellite arrives within the first half minute."""
    shares = rng.random(256)

    def navigation(satellite: int, start: GpsTime, seconds: int) -> Iterator[Sent]:
        for _, ephemeris in known_before(satellite, start, seconds):
            yield float(shares[satellite % 256] * _COVERED_S), ephemeris

    return replace(run, navigation=navigation)


def _new_issues(run: Setup, rng: Random) -> Setup:
    """Satellites change their ephemerides in the middle of the run, and tell the new ones within half a minute."""
    shares = rng.random(256)

    def navigation(satellite: int, start: GpsTime, seconds: int) -> Iterator[Sent]:
        yield 0.0, broadcast(satellite, start)
        newest = broadcast(satellite, start + float(seconds))
        yield max(newest.transmitted - start, 0.0) + float(shares[satellite % 256] * _COVERED_S), newest

    return replace(run, crosses=(run.seconds // 2, _ISSUES_S), navigation=navigation)


def _week_end(run: Setup, _rng: Random) -> Setup:
    return replace(run, crosses=(run.seconds // 2, _WEEK_S))


def _of_some(change: Callable[[Sent], Sent], rng: Random) -> Callable[[int, GpsTime, int], Iterator[Sent]]:
    """Return the ephemerides of a run, those of a tenth of the satellites changed."""
    chosen = rng.random(256) < 0.1

    def navigation(satellite: int, start: GpsTime, seconds: int) -> Iterator[Sent]:
        for sent in known_before(satellite, start, seconds):
            yield sent
            if chosen[satellite % 256]:
                yield change(sent)

    return navigation


def _wrong_orbits(run: Setup, rng: Random) -> Setup:
    """Of a tenth of the satellites another ephemeris arrives that is 30 m to 10 km off."""
    along_m, at_s = float(np.exp(rng.uniform(np.log(30.0), np.log(1e4)))), float(_second(rng))
    return replace(run, navigation=_of_some(lambda sent: (at_s, with_wrong_orbit(sent[1], along_m)), rng))


def _unhealthy(run: Setup, rng: Random) -> Setup:
    """A tenth of the satellites says that it is unhealthy."""
    at_s = float(_second(rng))
    return replace(run, navigation=_of_some(lambda sent: (at_s, replace(sent[1], health=1)), rng))


# The levels of each trouble. How it is without them is the first of LEVELS.
TROUBLES: Final[Mapping[str, Mapping[str, Change]]] = {
    "surroundings": {"streets": _streets, "forest": _forest},
    "outages": {"bridges": _bridges, "tunnel": _tunnel, "cutting": _cutting},
    "start": {"stands first": _stands_first},
    "phases": {
        "untold slips": _also(rover_slips),
        "base's untold slips": _also(base_slips),
        "told slips": lambda run, _: replace(run, rover=_slipping(run.rover)),
        "base's told slips": lambda run, _: replace(run, base=_slipping(run.base)),
        "half cycles unresolved": _unresolved,
        "half cycles flip": _also(_halves),
    },
    "codes": {
        "step": _also(bad_codes(1, 30.0, 30.0)),
        "ramp": _also(bad_codes(1, 0.0, 0.0, 0.1, 2.0)),
        "two bad": _also(bad_codes(2, 5.0, 40.0)),
        "three bad": _also(bad_codes(3, 5.0, 40.0)),
    },
    "link": {
        "late": _arriving(lambda rng: late(int(rng.integers(2, 11)))),
        "gaps": _gaps,
        "thinned": _arriving(lambda rng: thinned(int(rng.integers(2, 11)))),
        "restart": _restarting_base,
        "shifted": _shifted,
        "twice": lambda run, _: replace(run, arrivals=_twice),
        "swapped": lambda run, _: replace(run, arrivals=_swapped),
    },
    "clocks": {
        "rover's jumps": _jumping(rover=True, base=False),
        _OF_BASE[0]: _jumping(rover=False, base=True),
        _OF_BASE[1]: _jumping(rover=True, base=True),
    },
    "rover": {
        "restart": _restarting_rover,
        "epochs twice": lambda run, _: replace(run, rover_arrivals=_twice),
        "epochs swapped": lambda run, _: replace(run, rover_arrivals=_swapped),
    },
    "navigation": {
        "late": _told_late, "new issues": _new_issues, "end of week": _week_end, "wrong orbits": _wrong_orbits, "unhealthy": _unhealthy,
    },
}  # fmt: skip
NONE: Final = "no trouble"
_CROSSED_S: Final = {"new issues": _ISSUES_S, "end of week": _WEEK_S}


def _random_of(seed: int, run: int) -> Random:
    return np.random.default_rng((seed, run, _OF_TROUBLES))


def _drawn(rng: Random) -> Levels:
    """Return the level of each trouble."""
    levels, count = dict.fromkeys(TROUBLES, NONE), 1 + int(rng.choice(len(_COUNTS), p=_COUNTS))
    for factor in sorted(rng.choice(list(TROUBLES), count, replace=False).tolist()):
        levels[factor] = str(rng.choice(list(TROUBLES[factor])))
    return levels


def levels_of_run(seed: int, run: int) -> Levels:
    """Return the levels of a run: of its configuration and of its troubles."""
    return modes.levels_of_run(seed, run) | _drawn(_random_of(seed, run))


def twin_of_run(seed: int, run: int) -> tuple[Setup, Random]:
    """Return a run without its troubles; it ends before what its twin crosses, and the base's clock is of the same kind."""
    setup, rng = modes.setup_of_run(seed, run)
    troubles = _drawn(_random_of(seed, run))
    every_s = _CROSSED_S.get(troubles["navigation"])
    base = replace(setup.base, steered=setup.base.steered and troubles["clocks"] not in _OF_BASE)
    return replace(setup, seconds=SECONDS, crosses=None if every_s is None else (_BEFORE_S, every_s), base=base), rng


def setup_of_run(seed: int, run: int) -> tuple[Setup, Random]:
    """Return a run, and the random numbers that are left for it."""
    setup, rng = twin_of_run(seed, run)
    of_troubles = _random_of(seed, run)
    for factor, level in _drawn(of_troubles).items():
        if level != NONE:
            setup = TROUBLES[factor][level](setup, of_troubles)
    return setup, rng


def _levels() -> dict[str, frozenset[str]]:
    return {**modes.SCAN.levels, **{factor: frozenset((NONE, *levels)) for factor, levels in TROUBLES.items()}}


SCAN: Final = Scan("troubles.py", 1000, 150, _levels(), levels_of_run, setup_of_run, twin_of_run)


if __name__ == "__main__":
    sys.exit(scan.main(SCAN, __doc__))
