"""Errors of codes and phases of two receivers that stand still, by their single differences against a known baseline."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

import recorded
import slips
from cases import Case
from error_series import Collected, Series
from rtkmesh.codecs.messages import Message
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import GLONASS, SATELLITES_PER_SYSTEM
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.single import SinglePointOptions, locate, point_setup
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.relative import differences_of
from rtkmesh.rtk.residuals import CODE, CODE_VARIANCE, ELEVATION_RAD, PHASE, WAVELENGTH, Differences
from rtkmesh.rtk.setup import setup_of
from rtkmesh.rtk.solution import Status
from rtkmesh.rtk.state import new_filter
from rtkmesh.simulation.receiver import ReceiverOptions
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import static
from simulated import Setup, simulate

Vector = NDArray[np.float64]

_BANDS: Final = 2
_ENOUGH: Final = 8  # phases for a position
_OF_A_MEAN: Final = 4  # signals of a group: the mean of fewer is theirs in large part


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two receivers that stand still: epochs, navigation data, and the base's position and the baseline (m, ECEF)."""

    rover: Sequence[Epoch]
    base: Sequence[Epoch]
    navigation: Sequence[Message]
    base_ecef_m: Vector
    baseline_ecef_m: Vector
    options: RtkOptions


def recorded_pair(case: Case) -> Pair:
    """Return a recorded pair with the baseline of its middle fix."""
    fixes = [s for s in recorded.solutions(case, RtkOptions(systems=case.systems, frequencies=case.frequencies)) if s.status is Status.FIX]
    scene, baseline = slips.recorded(case.name, case), np.median(np.array([s.baseline_ecef_m for s in fixes]), axis=0)
    navigation = [message for _, message in scene.others]
    options = RtkOptions(systems=case.systems, frequencies=min(case.frequencies, _BANDS))
    return Pair(scene.rover, scene.base, navigation, np.array(case.base_ecef_m), baseline, options)


def simulated_pair(rover: ReceiverOptions, base: ReceiverOptions, seconds: int, seed: int) -> Pair:
    """Return two receivers of these classes that stand 280 m apart, somewhere on the earth."""
    setup = Setup(seconds=seconds, trajectory=static, rover=rover, base=base, base_enu_m=(-210.0, 180.0, 3.0))
    run = simulate(setup, np.random.default_rng((seed, 60)))
    navigation: list[Message] = [broadcast(s, run.start) for s in SATELLITES.tolist()]
    options = RtkOptions(systems=rover.systems, frequencies=min(rover.frequencies, base.frequencies))
    epochs = [b for b in run.base_epochs if b is not None]
    return Pair(run.rover_epochs, epochs, [*navigation, KLOBUCHAR], run.base_ecef_m, run.baseline_ecef_m[0], options)


def differences(pair: Pair) -> Iterator[tuple[float, Differences]]:
    """Yield times (s) and single differences of all epochs that both receivers have, modelled for its baseline."""
    table, setup = ephemerides(pair.navigation), setup_of(pair.options)
    point, f = point_setup(SinglePointOptions(systems=pair.options.systems)), new_filter()
    f.x[:3] = pair.baseline_ecef_m
    bases = {round((epoch.time - pair.base[0].time) * 10.0): epoch for epoch in pair.base}
    for epoch in pair.rover:
        base = bases.get(round((epoch.time - pair.base[0].time) * 10.0))
        if base is None:
            continue
        located = locate(epoch.signals, table.issues, point, pair.base_ecef_m + pair.baseline_ecef_m)
        yield (
            epoch.time - pair.rover[0].time,
            differences_of(
                f, epoch.signals, base.signals, located, table.issues.channel, point.klobuchar, pair.base_ecef_m, np.zeros(2), setup
            )[0],
        )


def ephemerides(navigation: Sequence[Message]) -> EphemerisTable:
    table = EphemerisTable()
    for message in navigation:
        if isinstance(message, KeplerEphemeris | GlonassEphemeris):
            table.add(message)
    return table


def code_errors_m(d: Differences) -> Vector:
    """Return the codes without the clocks of their groups (m); NaN where there is none."""
    return _without_clocks(d.table[:, CODE], d)


def phase_errors_m(d: Differences) -> Vector:
    """Return the phases without clocks and whole cycles (m); NaN where there is none, and of GLONASS, whose cycles differ."""
    cycles = d.table[:, PHASE] / d.table[:, WAVELENGTH]
    cycles[d.pairs.satellite // SATELLITES_PER_SYSTEM == GLONASS] = np.nan
    for group in range(d.pairs.groups):
        there = np.flatnonzero((d.pairs.group == group) & np.isfinite(cycles))
        if len(there):
            highest = there[np.argmax(d.table[there, ELEVATION_RAD])]
            cycles[there] -= cycles[highest]
    return _without_clocks((cycles - np.round(cycles)) * d.table[:, WAVELENGTH], d)


def _without_clocks(value_m: Vector, d: Differences) -> Vector:
    """Return values less the weighted mean of their clock group; NaN for groups that are too small."""
    out = np.full(len(value_m), np.nan)
    for group in range(d.pairs.groups):
        there = (d.pairs.group == group) & np.isfinite(value_m)
        if there.sum() >= _OF_A_MEAN:
            weight = 1.0 / d.table[there, CODE_VARIANCE]
            out[there] = value_m[there] - np.sum(weight * value_m[there]) / np.sum(weight)
    return out


def refined(pair: Pair) -> Pair:
    """Return the pair with the baseline that the phases say on average over all epochs; as it is where they are too few."""
    shifts: list[Vector] = []
    for _, d in differences(pair):
        error_m = phase_errors_m(d)
        there = np.isfinite(error_m)
        if there.sum() >= _ENOUGH:
            towards = [_without_clocks(np.where(there, -d.rover_direction[:, axis], np.nan), d) for axis in range(3)]
            shifts.append(np.linalg.lstsq(np.array(towards).T[there], error_m[there], rcond=None)[0])
    return pair if not shifts else replace(pair, baseline_ecef_m=pair.baseline_ecef_m + np.array(shifts).mean(axis=0))


def of_pair(pair: Pair) -> dict[str, list[Series]]:
    """Return the errors of codes (GLONASS apart) and phases of a pair."""
    codes, glonass, phases = Collected(), Collected(), Collected()
    for time_s, d in differences(refined(pair)):
        error_m, fdma = code_errors_m(d), d.pairs.satellite // SATELLITES_PER_SYSTEM == GLONASS
        keys, elevation_rad = d.pairs.key.tolist(), d.table[:, ELEVATION_RAD]
        codes.add(time_s, keys, elevation_rad, np.where(fdma, np.nan, error_m))
        glonass.add(time_s, keys, elevation_rad, np.where(fdma, error_m, np.nan))
        phases.add(time_s, keys, elevation_rad, phase_errors_m(d))
    return {"code": codes.series(), "GLONASS": glonass.series(), "phase": phases.series()}
