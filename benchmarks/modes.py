#!/usr/bin/env python3
"""Where is the engine wrong that no other table looks? Short simulated runs whose configurations are drawn, judged by the truth.

  modes.py [--runs N] [--seed S] [--only FACTOR=LEVEL|LEVEL,...] [--quick] [--json] [--jobs N]
  modes.py --run SEED:K [--trace]        one run again

Every run draws a level of each factor: mode, systems, frequencies, rate (10/1: the base sends once a second), receiver, ambiguities,
motion, the distance of the base, and whether this is a survey receiver or the same as the rover's; then it is as a run of the campaign
under open sky (families.py), 40 s long. Run K of a seed is the same however many there are and whatever --only asks for: this picks the
runs that have such levels (--only "mode=moving-base 2 m,systems=G|E,rate=5|10").

Tables: by each factor, by the pairs of levels that have wrong fixes in more runs than both their factors, and a command for every run with
wrong fixes. Columns as those of rates.py with bounds of 95 % confidence of the shares of fixes and of runs (the former as if fixes were
independent, which they are not). Runs whose ambiguities are "off" count for the last column alone.
"""

import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

import kernel_cache  # noqa: F401  first of all
import scan
from families import BASE, MOTIONS, Random, base_place, in_motion
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, Mode, RtkOptions
from rtkmesh.simulation.classes import F9P, M8, SURVEY
from rtkmesh.simulation.receiver import ReceiverOptions
from scan import OFF, Levels, Scan
from simulated import Offset, Setup, slopes_of_two_makes_m

SECONDS: Final = 40
_ABOVE_M: Final = -1.5  # of both antennas of a vehicle over its origin (down)
_FAR_M: Final = 10e3
_BASE_DRIFT: Final = -1.7e-7  # s/s, of a base that is as its rover

# Levels of each factor with their weights: what costs ten times as much is drawn more seldom.
MODES: Final = {"kinematic": 0.35, "moving-base 2 m": 0.2, "moving-base 20 m": 0.1, "static": 0.2, "static-start": 0.15}
SYSTEMS: Final = {"G": 0.2, "GR": 0.2, "GE": 0.15, "E": 0.15, "C": 0.1, "GREC": 0.2}
FREQUENCIES: Final = {"1": 0.5, "2": 0.5}
RATES: Final = {"1": 0.45, "5": 0.28, "10": 0.16, "10/1": 0.08, "20": 0.03}
AMBIGUITIES: Final = {"continuous": 0.5, "fix-and-hold": 0.2, "instantaneous": 0.2, OFF: 0.1}
BASES: Final = {"survey": 0.5, "same": 0.5}
DISTANCES: Final = {"50 m to 500 m": 0.4, "500 m to 5 km": 0.4, "10 km": 0.2}
_BOUNDS_M: Final = {"50 m to 500 m": (50.0, 500.0), "500 m to 5 km": (500.0, 5e3), "10 km": (0.9 * _FAR_M, 1.1 * _FAR_M)}
_RECEIVERS: Final[Mapping[str, ReceiverOptions]] = {"F9P": F9P, "SURVEY": SURVEY, "M8": M8}


class Configuration(NamedTuple):
    """The level of each factor of a run."""

    mode: str
    systems: str
    frequencies: str
    rate: str
    receiver: str
    ambiguities: str
    motion: str
    distance: str
    base: str


def one_of(rng: Random, weights: Mapping[str, float]) -> str:
    return str(rng.choice(list(weights), p=list(weights.values())))


def drawn(rng: Random) -> Configuration:
    """Return a configuration. In the static modes the rover stands; antennas of a vehicle have the distance of the mode and one rate."""
    mode, systems, frequencies, rate = (one_of(rng, weights) for weights in (MODES, SYSTEMS, FREQUENCIES, RATES))
    receiver, ambiguities, distance = str(rng.choice(list(_RECEIVERS))), one_of(rng, AMBIGUITIES), one_of(rng, DISTANCES)
    motion = "static" if mode in {Mode.STATIC, Mode.STATIC_START} else str(rng.choice(list(MOTIONS)))
    frequencies = "1" if receiver == "M8" else frequencies
    if length := length_of(mode):
        return Configuration(mode, systems, frequencies, rate.partition("/")[0], receiver, ambiguities, motion, length, "same")
    return Configuration(mode, systems, frequencies, rate, receiver, ambiguities, motion, distance, one_of(rng, BASES))


def length_of(mode: str) -> str:
    """Return the distance of the antennas of a vehicle, or nothing."""
    return mode.removeprefix(Mode.MOVING_BASE).strip() if mode.startswith(Mode.MOVING_BASE) else ""


def setup_of(c: Configuration, rng: Random) -> Setup:
    """Return what is simulated of a configuration and how it is solved."""
    trajectory, multipath_s = MOTIONS[c.motion]
    like = replace(_RECEIVERS[c.receiver], systems=c.systems, frequencies=int(c.frequencies))
    rover = in_motion(like, multipath_s)
    rover_hz, _, base_hz = c.rate.partition("/")
    run = Setup(seconds=SECONDS, rate_hz=int(rover_hz), base_rate_hz=int(base_hz or 0), options=_options_of(c), trajectory=trajectory)
    run = replace(run, rover=rover, base=replace(like, clock_drift=_BASE_DRIFT))
    if length := length_of(c.mode):
        arm: Offset = (-float(length.split()[0]), 0.0, _ABOVE_M)
        return replace(run, base=replace(rover, clock_drift=_BASE_DRIFT), base_moves=True, base_enu_m=arm)
    if c.base == "survey":
        run = replace(run, base=replace(BASE, signals=BASE.signals._replace(glonass_slopes_m=slopes_of_two_makes_m(rng))))
    return replace(run, base_enu_m=base_place(rng, *_BOUNDS_M[c.distance]))


def _options_of(c: Configuration) -> RtkOptions:
    mode = Mode.MOVING_BASE if length_of(c.mode) else Mode(c.mode)
    ambiguity = AmbiguityOptions(mode=AmbiguityMode(c.ambiguities))
    return RtkOptions(mode=mode, systems=c.systems, frequencies=int(c.frequencies), ambiguity=ambiguity)


def random_of(seed: int, run: int) -> Random:
    return np.random.default_rng((seed, run))


def configuration_of(seed: int, run: int) -> Configuration:
    """Return the configuration of a run."""
    return drawn(random_of(seed, run))


def levels_of_run(seed: int, run: int) -> Levels:
    """Return the levels of a run."""
    return configuration_of(seed, run)._asdict()


def setup_of_run(seed: int, run: int) -> tuple[Setup, Random]:
    """Return a run, and the random numbers that are left for it."""
    rng = random_of(seed, run)
    return setup_of(drawn(rng), rng), rng


def _levels() -> dict[str, frozenset[str]]:
    """Return the levels of each factor."""
    lengths = [length for length in map(length_of, MODES) if length]
    levels = (MODES, SYSTEMS, FREQUENCIES, RATES, _RECEIVERS, AMBIGUITIES, MOTIONS, (*DISTANCES, *lengths), BASES)
    return {factor: frozenset(of_factor) for factor, of_factor in zip(Configuration._fields, levels, strict=True)}


SCAN: Final = Scan("modes.py", 1000, 150, _levels(), levels_of_run, setup_of_run)


if __name__ == "__main__":
    sys.exit(scan.main(SCAN, __doc__))
