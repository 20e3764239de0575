#!/usr/bin/env python3
"""The attitude filters on simulated vehicles: errors, honesty of their sigmas, outages, endurance and cost.

  attitude_filter.py [--quick] [--runs N] [--updates N] [--seed S]

Rigid-body fits of 0.2 deg (heading) and 0.4 deg (pitch, roll) at 1 to 20 Hz, with and without a gyro (100 Hz, 0.2 deg/s a sample, a bias of
about 1 deg/s); the vehicles are those of rtkmesh.simulation whose headings do not jump. Errors and sigmas are taken at fixes and half-way
between them. NEES: mean of the squared error in units of its covariance, per degree of freedom: 1 is honest, more is too sure. RTKLIB has
no such filter.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import degrees, nan, radians, sqrt
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

import kernel_cache  # noqa: F401  first of all
from results import table
from rtkmesh.attitude.filter import AttitudeFilter
from rtkmesh.attitude.filter_options import Estimate, FilterOptions, Kind
from rtkmesh.attitude.heading_filter import filter_of
from rtkmesh.attitude.rigid_body import Fit, Shape
from rtkmesh.attitude.rotation import rotation_of, rotation_of_angles, vector_of
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.trajectories import Trajectory, boat, driving, drone, tractor, walking

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

FIT_COV: Final = np.diag(np.square(np.radians([0.4, 0.4, 0.2])))
GYRO_SIGMA_RADPS: Final = radians(0.2)
BIAS_SIGMA_RADPS, BIAS_WALK_RADPS_RTS = radians(1.0), 1e-4
START: Final = GpsTime(2445, 604_770.0)  # the week turns over after half a minute
SETTLED_S: Final = 5.0
BOAT_CYCLE_S: Final = 200.0  # its circle, and whole numbers of its waves
VEHICLES: Final[dict[str, Trajectory]] = {
    "car with turns": driving,
    "boat on waves": boat,
    "walker": walking,
    "drone": drone,
    "tractor": tractor,
}


@dataclass(frozen=True, slots=True)
class Ride:
    """How a vehicle is measured: ``gyro_hz`` 0 without one; after every ``open_s`` of fixes none for ``outage_s``."""

    trajectory: Trajectory
    fix_hz: float
    gyro_hz: float = 0.0
    seconds: float = 60.0
    open_s: float = 15.0
    outage_s: float = 0.0
    kind: Kind = Kind.ROTATION


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """A true rotation, the estimate, and whether an outage is about to end."""

    truth: Matrix
    estimate: Estimate
    outage_ends: bool


def truth_at(trajectory: Trajectory, time_s: float) -> Matrix:
    """Return ned_from_body."""
    pose = trajectory(time_s)
    return rotation_of_angles(pose.heading_rad, pose.pitch_rad, pose.roll_rad)


def rate_at(trajectory: Trajectory, time_s: float) -> Vector:
    """Return the body's rate (rad/s): a central difference."""
    h = 1e-4
    return vector_of(truth_at(trajectory, time_s - h).T @ truth_at(trajectory, time_s + h)) / (2.0 * h)


def measured(truth: Matrix, rng: np.random.Generator) -> Fit:
    """Return a fit with errors drawn from its covariance."""
    error = np.sqrt(np.diag(FIT_COV)) * rng.standard_normal(3)
    return Fit(rotation_of(error) @ truth, FIT_COV, np.full(3, nan), np.zeros((1, 3)), nan, 0, Shape.SPACE)


def ridden(ride: Ride, seed: int) -> Iterator[Moment]:
    """Ride once; yield what the filter says half-way between fixes and at them, once it has settled."""
    rng, attitude = np.random.default_rng(seed), filter_of(FilterOptions(kind=ride.kind))
    shift_s, bias = rng.uniform(0.0, 300.0), BIAS_SIGMA_RADPS * rng.standard_normal(3)
    steps = 2 if ride.gyro_hz == 0.0 else max(2, round(ride.gyro_hz / ride.fix_hz))  # between fixes
    for k in range(round(ride.seconds * ride.fix_hz * steps)):
        time_s = k / (ride.fix_hz * steps)
        phase_s, cycle_s = time_s % (ride.open_s + ride.outage_s), ride.open_s + ride.outage_s
        truth = truth_at(ride.trajectory, shift_s + time_s)
        if ride.gyro_hz > 0.0:
            bias = bias + BIAS_WALK_RADPS_RTS * sqrt(1.0 / (ride.fix_hz * steps)) * rng.standard_normal(3)
            rate = rate_at(ride.trajectory, shift_s + time_s) + bias + GYRO_SIGMA_RADPS * rng.standard_normal(3)
            attitude.gyro(START + time_s, rate, GYRO_SIGMA_RADPS)
        ends = ride.outage_s > 0.0 and phase_s + 1.0 / (ride.fix_hz * steps) > cycle_s - 1e-6
        open_ = ride.outage_s == 0.0 or phase_s < ride.open_s
        if k % steps == 0 and open_:
            attitude.rotation(START + time_s, measured(truth, rng))
        if time_s >= SETTLED_S and (k % steps in (0, steps // 2) or ends):
            yield Moment(truth, attitude.predicted(START + time_s), ends)


@dataclass(slots=True)
class Score:
    """Errors (deg, n x 3: about north, east, down), squares in units of covariance, and how often there was an attitude."""

    errors_deg: list[Vector]
    squares: list[float]
    asked: int = 0

    def add(self, moment: Moment) -> None:
        """Count a moment."""
        self.asked += 1
        if moment.estimate.ned_from_body is not None:
            error = vector_of(moment.truth @ moment.estimate.ned_from_body.T)
            self.errors_deg.append(np.degrees(error))
            self.squares.append(float(error @ np.linalg.solve(moment.estimate.cov_rad2, error)))

    @property
    def nees(self) -> float:
        """Mean square per degree of freedom."""
        return float(np.mean(self.squares)) / 3.0 if self.squares else nan

    @property
    def heading_deg(self) -> float:
        """Root mean square about down."""
        return sqrt(float(np.mean(np.square([e[2] for e in self.errors_deg])))) if self.errors_deg else nan

    @property
    def tilt_deg(self) -> float:
        """Root mean square about a horizontal axis."""
        return sqrt(float(np.mean(np.square([e[:2] for e in self.errors_deg])))) if self.errors_deg else nan

    @property
    def available_pct(self) -> float:
        """How often there was an attitude."""
        return 100.0 * len(self.squares) / self.asked if self.asked else nan


def at_outage_ends(moment: Moment) -> bool:
    """Whether no fix has come for the whole outage."""
    return moment.outage_ends


def scored(ride: Ride, runs: int, seed: int, wanted: Callable[[Moment], bool] = lambda _: True) -> Score:
    """Ride several times and score the moments that are wanted."""
    score = Score([], [])
    for run in range(runs):
        for moment in ridden(ride, seed + run):
            if wanted(moment):
                score.add(moment)
    return score


def by_rate(runs: int, seed: int) -> str:
    """Return errors and honesty by vehicle and rate of fixes, with and without a gyro."""
    return _page("fixes Hz", (1.0, 5.0, 10.0, 20.0), lambda vehicle, fix_hz, gyro_hz: scored(Ride(vehicle, fix_hz, gyro_hz), runs, seed))


def by_outage(runs: int, seed: int) -> str:
    """Return the same at the end of outages, after 15 s of fixes at 10 Hz."""

    def score(vehicle: Trajectory, outage_s: float, gyro_hz: float) -> Score:
        ride = Ride(vehicle, 10.0, gyro_hz, 4.0 * (15.0 + outage_s), outage_s=outage_s)
        return scored(ride, runs, seed, at_outage_ends)

    return _page("outage s", (1.0, 2.0, 5.0, 9.5), score)


def _page(what: str, values: tuple[float, ...], score: Callable[[Trajectory, float, float], Score]) -> str:
    """Return a table: a row per vehicle and value, each without and with a gyro."""
    figures = ("heading deg", "tilt deg", "NEES", "there %")
    rows = [
        [name, f"{value:g}", *_cells(score(vehicle, value, 0.0)), *_cells(score(vehicle, value, 100.0))]
        for name, vehicle in VEHICLES.items()
        for value in values
    ]
    return table(["vehicle", what, *figures, *[f"{figure}, gyro" for figure in figures]], rows)


def _cells(score: Score) -> list[str]:
    return [f"{score.heading_deg:.2f}", f"{score.tilt_deg:.2f}", f"{score.nees:.2f}", f"{score.available_pct:.0f}"]


def endured(updates: int, seed: int) -> tuple[float, bool, int]:
    """Give a filter that many inputs (gyro at 100 Hz, fixes at 10 Hz); return the smallest over the largest eigenvalue of the rotation's
    covariance ever seen, whether all was finite, and resets. The truth is of one cycle of the boat, again and again."""
    rng, attitude, worst, finite = np.random.default_rng(seed), AttitudeFilter(FilterOptions()), 1.0, True
    steps = min(updates // 11 * 10, round(100.0 * BOAT_CYCLE_S))
    rates, truths = [rate_at(boat, 0.01 * k) for k in range(steps)], [truth_at(boat, 0.1 * k) for k in range(-(-steps // 10))]
    for k in range(updates // 11 * 10):
        now, phase = START + 0.01 * k, k % steps
        attitude.gyro(now, rates[phase] + GYRO_SIGMA_RADPS * rng.standard_normal(3), GYRO_SIGMA_RADPS)
        if k % 10 == 0:
            attitude.rotation(now, measured(truths[phase // 10], rng))
            cov = attitude.predicted(now).cov_rad2
            finite = finite and bool(np.all(np.isfinite(cov)))
            values = np.linalg.eigvalsh(cov)
            worst = min(worst, float(values[0] / values[-1]))
    return worst, finite, attitude.resets


def costs(updates: int, seed: int) -> dict[str, float]:
    """Return the median time (ms) of each kind of input, and of a fix that is 0.2 s late beside a gyro at 100 Hz."""
    rng, times = np.random.default_rng(seed), Times()
    attitude, late, heading = (filter_of(FilterOptions(kind=kind)) for kind in (Kind.ROTATION, Kind.ROTATION, Kind.HEADING))
    for k in range(updates):
        time_s = 0.01 * k
        now, rate = START + time_s, rate_at(boat, time_s) + GYRO_SIGMA_RADPS * rng.standard_normal(3)
        times.of("gyro", attitude.gyro, now, rate, GYRO_SIGMA_RADPS)
        times.of("heading only: gyro", heading.gyro, now, rate, GYRO_SIGMA_RADPS)
        late.gyro(now, rate, GYRO_SIGMA_RADPS)
        if k % 10 == 0:
            fit = measured(truth_at(boat, time_s), rng)
            times.of("rotation", attitude.rotation, now, fit)
            times.of("heading only: rotation", heading.rotation, now, fit)
            times.of("predicted", attitude.predicted, now + 0.005)
            times.of("rotation, 0.2 s late", late.rotation, now + -0.2, measured(truth_at(boat, time_s - 0.2), rng))
    return times.medians_ms()


class Times:
    """How long calls take, by name."""

    def __init__(self) -> None:
        self._seconds: dict[str, list[float]] = {}

    def of(self, name: str, call: Callable[..., object], *arguments: object) -> None:
        """Call it and keep the time."""
        start = perf_counter()
        call(*arguments)
        self._seconds.setdefault(name, []).append(perf_counter() - start)

    def medians_ms(self) -> dict[str, float]:
        """Return the medians."""
        return {name: 1e3 * float(np.median(seconds)) for name, seconds in self._seconds.items()}


def main() -> int:
    options = _options()
    alone = [degrees(sqrt(FIT_COV[axis, axis])) for axis in (2, 0)]
    print(f"{options.runs} runs of 60 s a row; fits alone are {alone[0]:.1f} deg in heading and {alone[1]:.1f} deg in tilt.\n")
    print(by_rate(options.runs, options.seed))
    print("At the end of outages, after 15 s of fixes at 10 Hz:\n")
    print(by_outage(options.runs, options.seed))
    worst, finite, resets = endured(options.updates, options.seed)
    state = "all finite" if finite else "NOT all finite"
    print(f"{options.updates} inputs: smallest over largest eigenvalue of the covariance at least {worst:.1e}, {state}, {resets} resets.\n")
    print(table(("input", "ms, median"), [[name, f"{ms:.3f}"] for name, ms in costs(2000, options.seed).items()]))
    return int(not finite or worst <= 0.0)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="not needed")
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--updates", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="one run a row, ten thousand inputs")
    options = parser.parse_args()
    return argparse.Namespace(runs=1, updates=10_000, seed=options.seed) if options.quick else options


if __name__ == "__main__":
    sys.exit(main())
