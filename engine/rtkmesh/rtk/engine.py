"""The RTK engine: one epoch of rover and base in, one solution out.

``Rtk.step`` is the page of named steps; each step is a module beside this one.
"""

from dataclasses import replace
from math import nan, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.ephemeris import GlonassBias, KlobucharParameters
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM
from rtkmesh.models.atmosphere import klobuchar_vector
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.single import SinglePoint, SinglePointOptions, single_point
from rtkmesh.rtk.ambiguity import add_constraints
from rtkmesh.rtk.bookkeeping import (
    apply_slips,
    begin_ambiguities,
    candidate_pairs,
    find_places,
    grow,
    is_finite,
    place_of,
    remember,
    systems_of,
    wanted_keys,
)
from rtkmesh.rtk.filter import OK, posterior, predict_motion, reset_state
from rtkmesh.rtk.matching import Matcher, distinct
from rtkmesh.rtk.noise import CLOCK_DRIFT_MPS, IONOSPHERE_PPM, CodeScale
from rtkmesh.rtk.options import AmbiguityMode, Mode, RtkOptions
from rtkmesh.rtk.report import Outcome, from_single, report
from rtkmesh.rtk.residuals import CODE, ELEVATION_RAD, Conditions, Differences, combine, observe
from rtkmesh.rtk.slips import find_slips
from rtkmesh.rtk.solution import Reason, Solution
from rtkmesh.rtk.state import (
    ARC_EPOCHS,
    FIRST_PAIR_KEY,
    SEEN_S,
    SLOPE_KEY,
    ZENITH_KEY,
    FilterState,
    length_m,
    trace,
)
from rtkmesh.rtk.update import Layout, Update, update
from rtkmesh.rtk.validation import Candidates, LengthConstraint, Prediction, Resolution, Validation

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

_DECAY_S: Final = 5.0  # accelerations of robots last seconds
_RESEED_S: Final = 4.0  # beyond this gap the motion model says nothing and the single-point position takes over
_FORGET_S: Final = 65.0  # beyond this gap nothing is left
_SEED_SIGMA_M: Final = 30.0
_SEED_SPEED_MPS: Final = 10.0
_SEED_ACCELERATION_MPS2: Final = 3.0
_CODE_MEMORY_S: Final = 20.0  # correlation time of code multipath: 5 s and less gave half the fixes on patch antennas
# From here on the ionosphere is a state per satellite. Nearer, states cost more than they give: at 35 km 30 against 97 % right fixes.
_LONG_BASELINE_M: Final = 70e3
_IONOSPHERE_SIGMA_PPM: Final = 1.0e-6
_IONOSPHERE_WALK_PPM: Final = 0.012e-6  # per square root of second
_ZENITH_SIGMA_M: Final = 0.02
_ZENITH_WALK_M: Final = 5e-5  # per square root of second
_SLOPE_WALK_M: Final = 1e-6  # per square root of second: temperature
_COMPLEMENT_S: Final = 10.0  # how much older a base epoch may be that gives a system which the newest lacks
_ABSURD_CODE_M: Final = 12.0  # no receiver's codes are that bad together: the phases carry a wrong position
_ABSURD_EPOCHS: Final = 3
_FAR_M: Final = 200.0  # a prediction that is off the single-point position by more is not believed


class Rtk:
    """The engine of one rover and one base. Mutable; everything else in the package is a value."""

    def __init__(self, options: RtkOptions) -> None:
        self.options = options
        self._matcher = Matcher(options.systems, options.frequencies, options.excluded, options.cn0_mask_dbhz)
        self._state: FilterState | None = None
        self._scale = CodeScale()
        constraint = None
        if options.mode is Mode.MOVING_BASE and options.baseline_length_m is not None:
            constraint = LengthConstraint(options.baseline_length_m, options.baseline_sigma_m)
        self._validation = Validation(options.ambiguity, constraint)
        self._prediction: Prediction | None = None
        self._resets = 0
        self._absurd = 0
        self._was_fixed = False
        self._base_s = nan
        self._single: SinglePointOptions | None = None
        slip = options.slip
        self._slip_setup = np.array((slip.time_difference_cyc, slip.maximum_gap_s, float(options.mode is Mode.MOVING_BASE), 1.0))
        self._bases: list[Epoch] = []

    def reset(self) -> None:
        """Forget the filter; what was learned of the code's noise stays."""
        if self._state is not None:
            self._resets += 1
        self._state, self._prediction = None, None
        self._validation.reset()

    def step(
        self,
        rover: Epoch,
        base: Epoch | None,
        ephemerides: EphemerisTable,
        klobuchar: KlobucharParameters | None = None,
        *,
        base_position_ecef_m: Vector | None = None,
        glonass_bias: GlonassBias | None = None,  # noqa: ARG002  part of what a base says; see the docstring for why it changes nothing
    ) -> Solution:
        """Return the solution of a rover epoch with its base epoch (the same or an older one; None if there is none).

        ``base_position_ecef_m`` is the antenna of the base (not needed in moving-base mode). ``glonass_bias``
        changes nothing: a code bias that all channels share is part of the group's clock.
        """
        if self.options.ambiguity.mode is AmbiguityMode.INSTANTANEOUS:
            self._state, self._prediction = None, None
            self._validation.reset()
        single = single_point(rover, ephemerides, self._single_options(klobuchar), self._start())
        if self.options.mode is Mode.SINGLE:
            return from_single(rover, base, single)
        base_single = None
        if base is not None and self.options.mode is Mode.MOVING_BASE:
            base_single = single_point(base, ephemerides, self._single_options(klobuchar), base_position_ecef_m)
            base_position_ecef_m = base_single.position_ecef_m if base_single.ok else None
        reason = self._obstacle(rover, base, base_position_ecef_m)
        if reason is not Reason.OK or base is None or base_position_ecef_m is None:
            return replace(from_single(rover, base, single), reason=reason)
        state = self._seeded(rover, single, base_position_ecef_m)
        if state is None:
            return from_single(rover, base, single)
        return self._doubted(self._relative(state, rover, base, ephemerides, klobuchar, (single, base_single)))

    def _doubted(self, solution: Solution) -> Solution:
        """Begin anew when the codes contradict the phases' position beyond all multipath, epoch after epoch."""
        absurd = solution.code_rms_m > _ABSURD_CODE_M
        self._absurd = self._absurd + 1 if absurd else 0
        if self._absurd >= _ABSURD_EPOCHS:
            self._absurd = 0
            self.reset()
        return solution

    # --- where the filter starts and how it moves on ---

    def _start(self) -> Vector | None:
        return None if self._state is None else self._state.base_ecef_m + self._state.x[:3]

    def _single_options(self, klobuchar: KlobucharParameters | None) -> SinglePointOptions:
        o, last = self.options, self._single
        if last is not None and last.klobuchar is klobuchar:
            return last
        self._single = SinglePointOptions(
            systems=o.systems, elevation_mask_rad=min(o.elevation_mask_rad, 0.175), cn0_mask_dbhz=o.cn0_mask_dbhz, klobuchar=klobuchar,
            excluded=o.excluded,
        )  # fmt: skip
        return self._single

    def _obstacle(self, rover: Epoch, base: Epoch | None, base_position_ecef_m: Vector | None) -> Reason:
        """Return why there can be no relative solution."""
        if base is None:
            return Reason.NO_BASE
        limit = self.options.time_tolerance_s if self.options.mode is Mode.MOVING_BASE else self.options.max_age_s
        if abs(rover.time - base.time) > limit:
            return Reason.BASE_TOO_OLD
        if base_position_ecef_m is None or not np.isfinite(base_position_ecef_m).all():
            return Reason.NO_BASE_POSITION
        return Reason.OK

    @property
    def _moves(self) -> bool:
        """Whether the rover (or the baseline) moves."""
        if self.options.mode is Mode.STATIC_START:
            return self._was_fixed
        return self.options.mode in (Mode.KINEMATIC, Mode.MOVING_BASE, Mode.DGPS)

    def _seeded(self, rover: Epoch, single: SinglePoint, base_ecef_m: Vector) -> FilterState | None:
        """Return the state at the rover's epoch: moved on, or begun anew; None if there is nothing to begin with."""
        state = self._state
        if state is not None and not 0.0 <= (rover.time - state.origin) - state.time_s <= _FORGET_S:
            self.reset()
        elif state is not None:
            self._advance(state, rover.time - state.origin, single)
            if not is_finite(state.x, state.cov) or self._astray(state, single):
                self.reset()
        state = self._state
        if state is None:
            if not single.ok and self.options.mode is not Mode.FIXED:
                return None
            state = self._state = FilterState(rover.time, 9, np.zeros(9), np.zeros((9, 9)))
            state.base_ecef_m = base_ecef_m.copy()
            self._seed(state, single)
        shift = base_ecef_m - state.base_ecef_m
        if shift.any():
            if self.options.mode is not Mode.MOVING_BASE:
                state.x[:3] -= shift
            state.base_ecef_m = base_ecef_m.copy()
            state.base_s = nan
        return state

    def _seed(self, state: FilterState, single: SinglePoint) -> None:
        """Begin the dynamic states anew from the single-point position; the keyed states stay."""
        moving = self._moves
        fixed = self.options.fixed_position_ecef_m if self.options.mode is Mode.FIXED else None
        start = single.position_ecef_m if fixed is None else np.array(fixed)
        for i in range(9):
            sigma = (_SEED_SIGMA_M, _SEED_SPEED_MPS, _SEED_ACCELERATION_MPS2)[i // 3] if moving or i < 3 else 1e-6
            reset_state(state.x, state.cov, i, 0.0, sigma**2 if fixed is None or i >= 3 else 1e-8)
        state.x[:3] = start - state.base_ecef_m

    def _advance(self, state: FilterState, time_s: float, single: SinglePoint) -> None:
        """Move the state on to ``time_s``."""
        dt = time_s - state.time_s
        state.time_s = time_s
        if self._moves:
            if dt > _RESEED_S and single.ok:
                self._seed(state, single)
            else:
                if state.cov[3, 3] < 1e-9:  # static until now
                    for i in range(3, 9):
                        reset_state(state.x, state.cov, i, 0.0, (_SEED_SPEED_MPS if i < 6 else _SEED_ACCELERATION_MPS2) ** 2)
                predict_motion(state.x, state.cov, dt, _DECAY_S, self._motion_noise(state))
        ambiguity, ionosphere = self.options.dynamics.ambiguity_cyc**2 * dt, (_IONOSPHERE_WALK_PPM * state.baseline_m) ** 2 * dt
        grow(state.cov, state.keys, state.dynamic, ambiguity, ionosphere, _ZENITH_WALK_M**2 * dt, _SLOPE_WALK_M**2 * dt)

    def _motion_noise(self, state: FilterState) -> Matrix:
        """Return the spectral density of the jerk (ECEF)."""
        o = self.options.dynamics
        turn = enu_from_ecef_at(state.base_ecef_m + state.x[:3])
        h, v = o.acceleration_horizontal_mps2**2, o.acceleration_vertical_mps2**2
        return (turn.T * np.array((h, h, v))) @ turn

    def _astray(self, state: FilterState, single: SinglePoint) -> bool:
        if not single.ok or self.options.mode is Mode.FIXED:
            return False
        gap_m = length_m(state.base_ecef_m + state.x[:3] - single.position_ecef_m)
        return gap_m > _FAR_M + 5.0 * sqrt(trace(single.position_cov_ecef_m2))

    # --- one relative solution ---

    def _relative(
        self, state: FilterState, rover: Epoch, base: Epoch, table: EphemerisTable,
        klobuchar: KlobucharParameters | None, singles: tuple[SinglePoint, SinglePoint | None],
    ) -> Solution:  # fmt: skip
        model_ecef_m = state.base_ecef_m + state.x[:3]
        age_s = rover.time - base.time
        differences = self._differences(state, rover, base, table, klobuchar_vector(klobuchar))
        if distinct(differences.pairs.satellite, np.isfinite(differences.table[:, CODE])) < 4:
            return replace(from_single(rover, base, singles[0]), reason=Reason.FEW_COMMON_SATELLITES, age_s=age_s, resets=self._resets)
        self._base_s = base.time - state.origin
        layout = self._lay_out(state, differences)
        outcome = update(state, differences, layout, self._scale, self._velocity(singles))
        if not outcome.ok or not is_finite(state.x, state.cov):
            self.reset()
            return replace(from_single(rover, base, singles[0]), reason=Reason.FILTER_RESET, age_s=age_s, resets=self._resets)
        self._remember(state, differences, layout, outcome, model_ecef_m)
        candidates = self._candidates(state, differences, layout, outcome)
        resolution = self._validation.resolve(state, candidates, self._prediction)
        if resolution.x is not None:
            self._prediction = Prediction(resolution.x[:3].copy(), 0.0)
        self._hold(state, resolution)
        self._was_fixed = self._was_fixed or resolution.x is not None
        epoch = Outcome(differences, layout, outcome, resolution, age_s, self._moves, singles[1], self._resets)
        return report(rover, base, singles[0], state, epoch)

    def _differences(self, state: FilterState, rover: Epoch, base: Epoch, table: EphemerisTable, klobuchar: Vector) -> Differences:
        """Form the single differences; a system that this base epoch lacks comes from an earlier one.

        Lost messages make such epochs: RTCM 3 sends each system by itself.
        """
        if not self._bases or self._bases[-1] is not base:
            self._bases = [b for b in self._bases if 0.0 < base.time - b.time <= _COMPLEMENT_S] + [base]
        model_ecef_m, out = state.base_ecef_m + state.x[:3], None
        missing = systems_of(rover.satellite)
        for other in reversed(self._bases if self.options.mode is not Mode.MOVING_BASE else [base]):
            found = missing & systems_of(other.satellite)
            if not found and out is not None:
                continue
            missing &= ~found
            part = other if out is None else other.take((found >> (other.satellite // SATELLITES_PER_SYSTEM)) & 1 != 0)
            conditions = self._conditions(state, rover.time - other.time, other.time - state.origin)
            pairs = self._matcher.match(rover, part)
            made = observe(rover, part, pairs, table, klobuchar, model_ecef_m, state.base_ecef_m, conditions)
            out = made if out is None else combine(out, made)
            if not missing:
                break
        assert out is not None
        return out

    def _conditions(self, state: FilterState, age_s: float, base_s: float) -> Conditions:
        o = self.options
        length = state.baseline_m
        common = (CLOCK_DRIFT_MPS * age_s) ** 2 + (o.noise.ephemeris_m_per_m * length) ** 2
        if length < _LONG_BASELINE_M:
            common += (IONOSPHERE_PPM * length) ** 2
        noise = np.array((o.noise.phase_a_m, o.noise.phase_b_m, o.noise.code_ratio, common))
        return Conditions(noise, o.elevation_mask_rad, base_s)

    def _velocity(self, singles: tuple[SinglePoint, SinglePoint | None]) -> tuple[Vector, Matrix] | None:
        """Return the Doppler velocity relative to the base, with its covariance."""
        rover, base = singles
        if not self._moves or not rover.has_velocity:
            return None
        if self.options.mode is not Mode.MOVING_BASE:
            return rover.velocity_ecef_mps, rover.velocity_cov_ecef_m2ps2
        if base is None or not base.has_velocity:
            return None
        return rover.velocity_ecef_mps - base.velocity_ecef_mps, rover.velocity_cov_ecef_m2ps2 + base.velocity_cov_ecef_m2ps2

    def _lay_out(self, state: FilterState, differences: Differences) -> Layout:
        """Give every pair its states; deal with slips; begin new states."""
        pairs, table = differences.pairs, differences.table
        phases, atmosphere = self.options.mode is not Mode.DGPS, state.baseline_m > _LONG_BASELINE_M
        keys = wanted_keys(pairs.key, pairs.satellite, table, phases, atmosphere)
        dt = state.time_s - state.rover_s
        state.use_keys(keys, max(self.options.slip.maximum_gap_s, 2.5 * dt if dt == dt else 0.0))
        ambiguity, ionosphere, inflation = np.empty(len(pairs), np.int64), np.empty(len(pairs), np.int64), np.empty(len(pairs))
        find_places(state.keys, pairs.key, pairs.satellite, table, phases, atmosphere, ambiguity, ionosphere)
        self._begin_shared(state)
        self._slips(state, differences, ambiguity)
        memory = max(1.0, 2.0 * _CODE_MEMORY_S / max(dt, 1e-3)) if dt == dt else 1.0
        begin_ambiguities(
            state.x, state.cov, state.history, ambiguity, pairs.satellite, table, state.dynamic, state.time_s, memory, inflation
        )
        return Layout(ambiguity, ionosphere, 0 if atmosphere else -1, place_of(state.keys, SLOPE_KEY), inflation)

    def _begin_shared(self, state: FilterState) -> None:
        """Give a value to new states of the atmosphere and of the GLONASS slope; all of them count as seen."""
        count = int(state.keys.searchsorted(FIRST_PAIR_KEY))
        for i in range(count):
            if state.history[i, ARC_EPOCHS] >= 0.0:
                continue
            value, sigma = 0.0, _IONOSPHERE_SIGMA_PPM * state.baseline_m
            if state.keys[i] == ZENITH_KEY:
                sigma = _ZENITH_SIGMA_M
            elif state.keys[i] == SLOPE_KEY:
                value, sigma = self._validation.slope
            reset_state(state.x, state.cov, state.dynamic + i, value, sigma**2)
            state.history[i, ARC_EPOCHS] = 0.0
        state.history[:count, SEEN_S] = state.time_s

    def _slips(self, state: FilterState, differences: Differences, place: Indices) -> None:
        """Find slips; a jump of known size moves its ambiguity, one of unknown size begins it anew."""
        n, d = len(place), differences
        slip, jump, motion, motion_cov = np.zeros(n, np.int64), np.zeros(n), np.zeros(3), np.zeros((3, 3))
        times = np.array((state.time_s, self._base_s, state.rover_s, state.base_s))
        redundancy = find_slips(
            d.table, state.history, place, d.issue, d.flagged, d.lock_s, d.base_s, d.rover_direction, d.base_direction, times,
            self._slip_setup, slip, jump, motion, motion_cov,
        )  # fmt: skip
        self._predict_fix(state, redundancy, motion, motion_cov)
        apply_slips(state.x, state.cov, state.history, place, slip, jump, state.dynamic, state.time_s)

    def _predict_fix(self, state: FilterState, redundancy: int, motion: Vector, motion_cov: Matrix) -> None:
        """Carry the last fix on by the motion that the phases show."""
        last = self._prediction
        if last is None or redundancy < 1 or self.options.mode is Mode.MOVING_BASE:
            self._prediction = None
            return
        moved = state.base_ecef_m + state.x[:3] - state.rover_model_ecef_m + motion
        self._prediction = Prediction(last.baseline_ecef_m + moved, last.sigma_m + sqrt(trace(motion_cov)))

    def _remember(self, state: FilterState, differences: Differences, layout: Layout, outcome: Update, model_ecef_m: Vector) -> None:
        """Write the history of this epoch."""
        d = differences
        remember(state.history, layout.ambiguity, d.table, d.base_s, d.lock_s, d.issue, outcome.phase_used, state.time_s)
        state.rover_s, state.base_s = state.time_s, self._base_s
        state.rover_model_ecef_m = model_ecef_m

    def _candidates(self, state: FilterState, differences: Differences, layout: Layout, outcome: Update) -> Candidates:
        """Return the ambiguities of this epoch that may become integers."""
        o, pairs, chosen = self.options.ambiguity, differences.pairs, np.empty(len(differences.pairs), np.int64)
        count = candidate_pairs(
            state.history, layout.ambiguity, pairs.satellite, differences.table, outcome.phase_used, o.elevation_mask_rad,
            float(o.minimum_lock_epochs), chosen,
        )  # fmt: skip
        chosen = chosen[:count]
        return Candidates(
            layout.ambiguity[chosen],
            pairs.group[chosen],
            pairs.satellite[chosen].astype(np.int64),
            differences.table[chosen, ELEVATION_RAD],
        )

    def _hold(self, state: FilterState, resolution: Resolution) -> None:
        """In fix-and-hold, tell the filter of integers that have proven themselves (softly, so that it can still object)."""
        o = self.options.ambiguity
        if o.mode is not AmbiguityMode.FIX_AND_HOLD or resolution.pairs is None or resolution.integers is None or resolution.grade < 3:
            return
        if self._validation.confirmations < o.hold_after_epochs:
            return
        n = len(state.x)
        N, b, P, dx = np.zeros((n, n)), np.zeros(n), np.empty((n, n)), np.empty(n)
        add_constraints(resolution.pairs, state.x, resolution.integers, o.hold_variance_cyc2, N, b)
        if posterior(state.cov, N, b, P, dx) == OK:
            state.x, state.cov = state.x + dx, P
