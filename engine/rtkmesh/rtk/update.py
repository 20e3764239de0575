"""The screened measurement update: observations from differences, the update, its residuals, what they say of the noise."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.signals import SYSTEMS
from rtkmesh.rtk.filter import (
    AT_AMBIGUITY,
    AT_IONOSPHERE,
    AT_SLOPE,
    AT_ZENITH,
    GROUP,
    H_AMBIGUITY,
    H_IONOSPHERE,
    H_SLOPE,
    H_X,
    H_ZENITH,
    OBSERVATION,
    OK,
    PLACES,
    W,
    Y,
    normal_equations,
    posterior,
    residuals,
)  # fmt: skip
from rtkmesh.rtk.noise import CodeScale
from rtkmesh.rtk.residuals import CHANNEL, CODE, CODE_VARIANCE, ELEVATION_RAD, IONOSPHERE, PHASE, PHASE_VARIANCE, WAVELENGTH, Differences
from rtkmesh.rtk.state import FilterState
from rtkmesh.rtk.velocity import add_velocity

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

CODE_LIMIT: Final = 4.0  # normalised residuals beyond these are left out
PHASE_LIMIT: Final = 4.5
_ROUNDS: Final = 8
_RESCALE: Final = 1.25  # the update is made again when the code's variance factor turns out to be off by this


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """Outcome of an update: residuals (m; of observations left out: predicted ones), which were used, and the fit of the phases."""

    ok: bool
    code_residual_m: Vector
    phase_residual_m: Vector
    code_used: NDArray[np.bool_]
    phase_used: NDArray[np.bool_]
    phase_chi2: float
    phase_dof: float


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Where the states of each pair are (rows of the filter's keys, -1: none) and how much its code's variance is inflated."""

    ambiguity: Indices
    ionosphere: Indices
    zenith: int
    slope: int
    code_inflation: Vector


@kernel
def fill_observations(
    table: Matrix, direction: Matrix, group: Indices, groups: int, ambiguity: Indices, ionosphere: Indices, zenith: int, slope: int,
    inflation: Vector, scale: Vector, keyed: Vector, out: Matrix, places: Indices,
) -> None:  # fmt: skip
    """Write code (first n rows) and phase (last n rows) observations of n pairs; ``scale`` is the code variance factor per pair,
    ``keyed`` the keyed part of the state.
    """
    n = len(group)
    for k in range(n):
        sin_el = np.sin(table[k, ELEVATION_RAD])
        mapping = 1.001 / np.sqrt(0.002001 + sin_el * sin_el)  # Black and Eisner 1984
        for part in range(2):
            row = k + part * n
            for i in range(3):
                out[row, H_X + i] = -direction[k, i]
            out[row, H_ZENITH] = mapping
            out[row, H_IONOSPHERE] = table[k, IONOSPHERE] if part == 0 else -table[k, IONOSPHERE]
            out[row, H_AMBIGUITY] = table[k, WAVELENGTH]
            places[row, GROUP] = group[k] + part * groups
            places[row, AT_ZENITH] = zenith
            places[row, AT_IONOSPHERE] = ionosphere[k]
            places[row, AT_AMBIGUITY] = ambiguity[k] if part == 1 else -1
            out[row, H_SLOPE] = table[k, CHANNEL]
            places[row, AT_SLOPE] = slope if part == 1 and table[k, CHANNEL] != 0.0 else -1
            y = table[k, CODE] if part == 0 else table[k, PHASE]
            variance = table[k, CODE_VARIANCE] * inflation[k] * scale[k] if part == 0 else table[k, PHASE_VARIANCE]
            for i in range(4):
                if places[row, AT_ZENITH + i] >= 0:
                    y -= out[row, H_ZENITH + i] * keyed[places[row, AT_ZENITH + i]]
            usable = np.isfinite(y) and np.isfinite(variance) and (part == 0 or ambiguity[k] >= 0)
            out[row, Y] = y if usable else 0.0
            out[row, W] = 1.0 / variance if usable else 0.0


@kernel
def code_statistics(
    observations: Matrix, value: Vector, variance: Vector, table: Matrix, system: Indices, squares: Vector, dof: Vector
) -> None:
    """Add up, per system, squared code residuals normalised by the sigma for a factor of 1, and their redundancy."""
    squares[:] = 0.0
    dof[:] = 0.0
    for k in range(len(system)):
        w = observations[k, W]
        if not w > 0.0:
            continue
        redundancy = min(max(variance[k] * w, 0.0), 1.0)
        squares[system[k]] += min(value[k] ** 2 / table[k, CODE_VARIANCE], 60.0 * redundancy)
        dof[system[k]] += redundancy


@kernel
def screen(observations: Matrix, places: Indices, value: Vector, variance: Vector, count: int, limits: Vector) -> int:
    """Put aside (negative weight) the worst observation of each group that is beyond its limit, if it is not far better than the worst
    of all; return how many. The first ``count`` rows are codes.
    """
    worst = 0.0
    ratio = np.zeros(observations.shape[0])
    for k in range(observations.shape[0]):
        w = observations[k, W]
        if w > 0.0 and variance[k] > 0.01 / w:
            ratio[k] = abs(value[k]) / np.sqrt(variance[k]) / limits[0 if k < count else 1]
            worst = max(worst, ratio[k])
    if worst <= 1.0:
        return 0
    put_aside = 0
    for k in range(observations.shape[0]):
        if ratio[k] < 1.0 or ratio[k] < 0.5 * worst:
            continue
        best_of_group = True
        for j in range(observations.shape[0]):
            if places[j, GROUP] == places[k, GROUP] and (ratio[j] > ratio[k] or (ratio[j] == ratio[k] and j < k)):
                best_of_group = False
        if best_of_group:
            observations[k, W] = -observations[k, W]
            put_aside += 1
    return put_aside


def update(
    state: FilterState, differences: Differences, layout: Layout, scale: CodeScale, velocity: tuple[Vector, Matrix] | None
) -> Update:  # fmt: skip
    """Update the state by the differences (and a velocity, m/s with covariance, in moving modes); learn the code's noise."""
    work = _Work(state, differences, layout, velocity)
    factors = scale.factors()
    ok = work.solve(factors)
    trial = scale.trial(*work.statistics())
    if ok and _differ(trial, factors):
        ok = work.solve(trial)
        trial = scale.trial(*work.statistics())
        if _differ(trial, factors):
            ok = work.solve(trial)
    for _ in range(_ROUNDS):
        if not ok or work.screen() == 0:
            break
        ok = work.adjust()
    if ok:
        scale.learn(*work.statistics())
        state.x = state.x + work.dx
        state.cov = work.P_new
    return work.outcome(ok)


def _differ(trial: Vector, factors: Vector) -> bool:
    return bool((np.maximum(trial / factors, factors / trial) > _RESCALE).any())


class _Work:
    """The arrays of one update."""

    def __init__(self, state: FilterState, differences: Differences, layout: Layout, velocity: tuple[Vector, Matrix] | None) -> None:
        n, states = len(differences.pairs), len(state.x)
        self.state, self.differences, self.layout, self.velocity = state, differences, layout, velocity
        self.count, self.groups = n, differences.pairs.groups
        self.system = (differences.pairs.satellite // 64).astype(np.int64)
        self.observations, self.places = np.empty((2 * n, OBSERVATION)), np.empty((2 * n, PLACES), np.int64)
        self.N, self.b = np.empty((states, states)), np.empty(states)
        self.mean = np.empty((2 * self.groups, states + 2))
        self.P_new, self.dx = np.empty((states, states)), np.empty(states)
        self.value, self.variance = np.empty(2 * n), np.empty(2 * n)

    def solve(self, factors: Vector) -> bool:
        """Set up the observations with these code factors and adjust."""
        layout, d = self.layout, self.differences
        fill_observations(
            d.table, d.rover_direction, d.pairs.group, self.groups, layout.ambiguity, layout.ionosphere, layout.zenith, layout.slope,
            layout.code_inflation, factors[self.system], self.state.x[self.state.dynamic :], self.observations, self.places,
        )  # fmt: skip
        return self.adjust()

    def adjust(self) -> bool:
        """Adjust with the weights as they are; False if the covariance is not positive definite any more."""
        dynamic = self.state.dynamic
        normal_equations(self.observations, self.places, dynamic, 2 * self.groups, self.N, self.b, self.mean)
        if self.velocity is not None:
            add_velocity(self.state.x, self.state.cov, *self.velocity, self.N, self.b)
        if posterior(self.state.cov, self.N, self.b, self.P_new, self.dx) != OK:
            return False
        residuals(self.observations, self.places, dynamic, self.mean, self.P_new, self.dx, False, self.value, self.variance)
        return True

    def statistics(self) -> tuple[Vector, Vector]:
        """Return sums of squares and degrees of freedom of the codes per system."""
        squares, dof = np.zeros(len(SYSTEMS)), np.zeros(len(SYSTEMS))
        code_statistics(self.observations, self.value, self.variance, self.differences.table, self.system, squares, dof)
        return squares, dof

    def screen(self) -> int:
        """Put aside what does not fit; return how many."""
        return screen(self.observations, self.places, self.value, self.variance, self.count, _LIMITS)

    def outcome(self, ok: bool) -> Update:
        """Return residuals and what was used."""
        n, used = self.count, self.observations[:, W] > 0.0
        phase, w = used[n:], self.observations[n:, W]
        redundancy = np.minimum(np.maximum(self.variance[n:][phase] * w[phase], 0.0), 1.0)
        chi2 = float(np.sum(self.value[n:][phase] ** 2 * w[phase]))
        return Update(ok, self.value[:n], self.value[n:], used[:n], phase, chi2, float(np.sum(redundancy)))


_LIMITS = np.array((CODE_LIMIT, PHASE_LIMIT))
