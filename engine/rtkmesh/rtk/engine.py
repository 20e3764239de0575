"""The RTK engine: one epoch of rover and base in, one solution out.

``Rtk.step`` is the page of named steps; each step is a module beside this one.
"""

from dataclasses import replace
from math import isfinite, nan, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.ephemeris import GlonassBias, KlobucharParameters
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM
from rtkmesh.models.ephemeris_table import EphemerisTable, Issues
from rtkmesh.models.single import Located, PointSetup, SinglePointOptions, locate, point_setup
from rtkmesh.models.single_adjustment import CONVERGED
from rtkmesh.rtk.bookkeeping import (
    Arranged,
    Walks,
    find_candidates,
    grow,
    is_finite,
    lay_out,
    move,
    remember,
    seed,
    systems_of,
)
from rtkmesh.rtk.matching import distinct, match, matching_rules
from rtkmesh.rtk.noise import CLOCK_DRIFT_MPS, IONOSPHERE_PPM, new_code_scale
from rtkmesh.rtk.options import AmbiguityMode, Mode, RtkOptions
from rtkmesh.rtk.report import Outcome, from_single, report
from rtkmesh.rtk.residuals import CODE, Conditions, Differences, combine, observe
from rtkmesh.rtk.slips import SlipSetup
from rtkmesh.rtk.solution import Reason, Solution
from rtkmesh.rtk.state import DYNAMIC, FilterState, length_m, trace
from rtkmesh.rtk.update import Layout, Update, update
from rtkmesh.rtk.validation import SLOPE, SLOPE_SIGMA, Resolution, forget, new_memory, not_resolved, resolve, resolve_setup

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_DECAY_S: Final = 5.0  # accelerations of robots last seconds
_RESEED_S: Final = 4.0  # beyond this gap the motion model says nothing and the single-point position takes over
_FORGET_S: Final = 65.0  # beyond this gap nothing is left
# Sigmas of position (m), velocity (m/s) and acceleration (m/s2) of a new filter: of what moves, stands, and has a known position.
_SEED_MOVING: Final = np.array((30.0, 10.0, 3.0))
_SEED_STANDING: Final = np.array((30.0, 1e-6, 1e-6))
_SEED_FIXED: Final = np.array((1e-4, 1e-6, 1e-6))
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
_NOWHERE: Final = np.full(3, nan)
_UNKNOWN: Final = np.full((3, 3), nan)
_NO_PREDICTION: Final = np.full(4, nan)


class Rtk:
    """The engine of one rover and one base. Mutable; everything else in the package is a value."""

    def __init__(self, options: RtkOptions) -> None:
        self.options = options
        self._rules = matching_rules(options.systems, options.frequencies, options.excluded, options.cn0_mask_dbhz)
        self._state: FilterState | None = None
        self._scale = new_code_scale()
        constrained = options.mode is Mode.MOVING_BASE and options.baseline_length_m is not None
        self._resolve = resolve_setup(options.ambiguity, options.baseline_length_m if constrained else None, options.baseline_sigma_m)
        self._memory = new_memory()
        self._prediction = _NO_PREDICTION
        self._resets = 0
        self._absurd = 0
        self._was_fixed = False
        self._base_s = nan
        self._klobuchar: KlobucharParameters | None = None
        self._point = self._point_setup(None)
        slip = options.slip
        self._slip = SlipSetup(slip.time_difference_cyc, slip.maximum_gap_s, options.mode is Mode.MOVING_BASE, True)
        self._bases: list[Epoch] = []

    def reset(self) -> None:
        """Forget the filter; what was learned of the code's noise stays."""
        if self._state is not None:
            self._resets += 1
        self._forget()

    def _forget(self) -> None:
        self._state, self._prediction = None, _NO_PREDICTION
        forget(self._memory)

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
            self._forget()
        if klobuchar is not self._klobuchar:
            self._klobuchar, self._point = klobuchar, self._point_setup(klobuchar)
        issues, base_single = ephemerides.issues, None
        single = locate(rover.signals, issues, self._point, _NOWHERE if self._state is None else self._state.rover_ecef_m)
        if self.options.mode is Mode.SINGLE:
            return from_single(rover, base, single)
        if base is not None and self.options.mode is Mode.MOVING_BASE:
            base_single = locate(base.signals, issues, self._point, _NOWHERE if base_position_ecef_m is None else base_position_ecef_m)
            base_position_ecef_m = base_single.position_ecef_m if base_single.status == CONVERGED else None
        reason = self._obstacle(rover, base, base_position_ecef_m)
        if reason is not Reason.OK or base is None or base_position_ecef_m is None:
            return replace(from_single(rover, base, single), reason=reason)
        state = self._seeded(rover, single, base_position_ecef_m)
        if state is None:
            return from_single(rover, base, single)
        return self._doubted(self._relative(state, rover, base, issues, (single, base_single)))

    def _doubted(self, solution: Solution) -> Solution:
        """Begin anew when the codes contradict the phases' position beyond all multipath, epoch after epoch."""
        absurd = solution.code_rms_m > _ABSURD_CODE_M
        self._absurd = self._absurd + 1 if absurd else 0
        if self._absurd >= _ABSURD_EPOCHS:
            self._absurd = 0
            self.reset()
        return solution

    # --- where the filter starts and how it moves on ---

    def _point_setup(self, klobuchar: KlobucharParameters | None) -> PointSetup:
        o = self.options
        return point_setup(SinglePointOptions(
            systems=o.systems, elevation_mask_rad=min(o.elevation_mask_rad, 0.175), cn0_mask_dbhz=o.cn0_mask_dbhz, klobuchar=klobuchar,
            excluded=o.excluded,
        ))  # fmt: skip

    def _obstacle(self, rover: Epoch, base: Epoch | None, base_position_ecef_m: Vector | None) -> Reason:
        """Return why there can be no relative solution."""
        if base is None:
            return Reason.NO_BASE
        limit = self.options.time_tolerance_s if self.options.mode is Mode.MOVING_BASE else self.options.max_age_s
        if abs(rover.time - base.time) > limit:
            return Reason.BASE_TOO_OLD
        if base_position_ecef_m is None or not isfinite(base_position_ecef_m.sum()):
            return Reason.NO_BASE_POSITION
        return Reason.OK

    @property
    def _moves(self) -> bool:
        """Whether the rover (or the baseline) moves."""
        if self.options.mode is Mode.STATIC_START:
            return self._was_fixed
        return self.options.mode in (Mode.KINEMATIC, Mode.MOVING_BASE, Mode.DGPS)

    def _seeded(self, rover: Epoch, single: Located, base_ecef_m: Vector) -> FilterState | None:
        """Return the state at the rover's epoch: moved on, or begun anew; None if there is nothing to begin with."""
        state = self._state
        if state is not None:
            dt = (rover.time - state.origin) - state.time_s
            if not 0.0 <= dt <= _FORGET_S:
                self.reset()
            else:
                self._advance(state, dt, single)
                if not is_finite(state.filter.x, state.filter.P) or self._astray(state, single):
                    self.reset()
        state = self._state
        if state is None:
            if single.status != CONVERGED and self.options.mode is not Mode.FIXED:
                return None
            state = self._state = FilterState(rover.time, base_ecef_m=base_ecef_m.copy())
            self._seed(state, single)
        shift = base_ecef_m - state.base_ecef_m
        if shift.any():
            if self.options.mode is not Mode.MOVING_BASE:
                state.filter.x[:3] -= shift
            state.base_ecef_m = base_ecef_m.copy()
            state.base_s = nan
        return state

    def _seed(self, state: FilterState, single: Located) -> None:
        """Begin the dynamic states anew from the single-point position; the keyed states stay."""
        fixed = self.options.fixed_position_ecef_m if self.options.mode is Mode.FIXED else None
        start = single.position_ecef_m if fixed is None else np.array(fixed)
        sigmas = _SEED_MOVING if self._moves else _SEED_STANDING
        seed(state.filter, start - state.base_ecef_m, sigmas if fixed is None else _SEED_FIXED)

    def _advance(self, state: FilterState, dt: float, single: Located) -> None:
        """Move the state on by ``dt`` seconds."""
        state.time_s += dt
        o = self.options.dynamics
        if self._moves and dt > _RESEED_S and single.status == CONVERGED:
            self._seed(state, single)
        elif self._moves:
            move(state.filter, dt, _DECAY_S, state.base_ecef_m, o.acceleration_horizontal_mps2, o.acceleration_vertical_mps2, _SEED_MOVING)
        grow(state.filter.P, state.filter.keys, DYNAMIC, self._walks(state), dt)

    def _walks(self, state: FilterState) -> Walks:
        length = state.baseline_m
        return Walks(
            self.options.dynamics.ambiguity_cyc, _IONOSPHERE_WALK_PPM * length, _IONOSPHERE_SIGMA_PPM * length, _ZENITH_WALK_M,
            _ZENITH_SIGMA_M, _SLOPE_WALK_M, (float(self._memory[SLOPE]), float(self._memory[SLOPE_SIGMA])), _CODE_MEMORY_S,
        )  # fmt: skip

    def _astray(self, state: FilterState, single: Located) -> bool:
        if single.status != CONVERGED or self.options.mode is Mode.FIXED:
            return False
        gap_m = length_m(state.rover_ecef_m - single.position_ecef_m)
        return gap_m > _FAR_M + 5.0 * sqrt(trace(single.covariance_m2))

    # --- one relative solution ---

    def _relative(
        self, state: FilterState, rover: Epoch, base: Epoch, issues: Issues, singles: tuple[Located, Located | None]
    ) -> Solution:  # fmt: skip
        single, model_ecef_m, age_s = singles[0], state.rover_ecef_m, rover.time - base.time
        differences = self._differences(state, rover, base, issues, single)
        if distinct(differences.pairs.satellite, np.isfinite(differences.table[:, CODE])) < 4:
            return replace(from_single(rover, base, single), reason=Reason.FEW_COMMON_SATELLITES, age_s=age_s, resets=self._resets)
        base_s = base.time - state.origin
        times_s = np.array((state.time_s, base_s, state.rover_s, state.base_s))
        phases, atmosphere = self.options.mode is not Mode.DGPS, 2 if state.baseline_m > _LONG_BASELINE_M else 0
        arranged = lay_out(state.filter, differences, times_s, self._slip, self._walks(state), phases, atmosphere)
        state.filter = arranged.filter
        self._predict_fix(state, arranged)
        outcome = update(state.filter, differences, arranged.layout, self._scale, *self._velocity(singles))
        if not outcome.ok or not is_finite(state.filter.x, state.filter.P):
            self.reset()
            return replace(from_single(rover, base, single), reason=Reason.FILTER_RESET, age_s=age_s, resets=self._resets)
        remember(state.filter, differences, arranged.layout, outcome.phase_used, state.time_s)
        state.rover_s, state.base_s, state.rover_model_ecef_m = state.time_s, base_s, model_ecef_m
        resolution = self._resolved(state, differences, arranged.layout, outcome)
        self._was_fixed = self._was_fixed or resolution.fixed
        result = Outcome(differences, arranged.layout, outcome, resolution, age_s, self._moves, singles[1], self._resets)
        return report(rover, base, single, state, result)

    def _differences(self, state: FilterState, rover: Epoch, base: Epoch, issues: Issues, single: Located) -> Differences:
        """Form the single differences; a system that this base epoch lacks comes from an earlier one.

        Lost messages make such epochs: RTCM 3 sends each system by itself.
        """
        if not self._bases or self._bases[-1] is not base:
            self._bases = [b for b in self._bases if 0.0 < base.time - b.time <= _COMPLEMENT_S] + [base]
        model_ecef_m, signals, klobuchar, out = state.rover_ecef_m, rover.signals, self._point.klobuchar, None
        missing = systems_of(rover.satellite)
        for other in reversed(self._bases if self.options.mode is not Mode.MOVING_BASE else [base]):
            found = missing & systems_of(other.satellite)
            if not found and out is not None:
                continue
            missing &= ~found
            part = other if out is None else other.take((found >> (other.satellite // SATELLITES_PER_SYSTEM)) & 1 != 0)
            conditions = self._conditions(state, rover.time - other.time, other.time - state.origin)
            pairs = match(signals, part.signals, self._rules)
            made = observe(signals, part.signals, pairs, single, issues.channel, klobuchar, model_ecef_m, state.base_ecef_m, conditions)
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

    def _velocity(self, singles: tuple[Located, Located | None]) -> tuple[Vector, Matrix]:
        """Return the Doppler velocity relative to the base, with its covariance; NaN without."""
        rover, base = singles
        if not self._moves:
            return _NOWHERE, _UNKNOWN
        if self.options.mode is not Mode.MOVING_BASE:
            return rover.velocity_mps, rover.velocity_cov_m2ps2
        if base is None:
            return _NOWHERE, _UNKNOWN
        return rover.velocity_mps - base.velocity_mps, rover.velocity_cov_m2ps2 + base.velocity_cov_m2ps2

    def _predict_fix(self, state: FilterState, arranged: Arranged) -> None:
        """Carry the last fix on by the motion that the phases show."""
        last = self._prediction
        if not isfinite(last[3]) or arranged.redundancy < 1 or self.options.mode is Mode.MOVING_BASE:
            self._prediction = _NO_PREDICTION
            return
        moved = state.rover_ecef_m - state.rover_model_ecef_m + arranged.motion_m
        self._prediction = np.append(last[:3] + moved, last[3] + sqrt(trace(arranged.motion_cov_m2)))

    def _resolved(self, state: FilterState, differences: Differences, layout: Layout, outcome: Update) -> Resolution:
        """Return what is known of integers, and carry the fix on as the next epoch's prediction."""
        o = self.options.ambiguity
        if o.mode is AmbiguityMode.OFF:
            return not_resolved(Reason.AMBIGUITY_OFF)
        candidates = find_candidates(
            state.filter, differences, layout, outcome.phase_used, o.elevation_mask_rad, float(o.minimum_lock_epochs)
        )
        resolution = resolve(state.filter, candidates, self._memory, self._resolve, self._prediction, state.time_s)
        if resolution.fixed:
            self._prediction = np.append(resolution.x[:3], 0.0)
        return resolution
