"""The RTK engine: one epoch of rover and base in, one solution out.

``Rtk.step`` is the page of named steps; each step is a module beside this one.

The filter's clock always runs forward. In an engine that goes backward through the epochs it counts the seconds *before* its origin, so
that velocities on it have the other sign; models see the time of the epochs themselves, and nothing else knows of the direction.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import reduce
from math import inf, isfinite, nan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.ephemeris import GlonassBias, KlobucharParameters
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.antenna import NO_PATTERNS, Antenna, join_patterns
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.single import Located, PointSetup, SinglePointOptions, locate_epoch, point_setup
from rtkmesh.models.single_adjustment import CONVERGED
from rtkmesh.rtk.acceptance import FAR_M
from rtkmesh.rtk.around import Around, Past, at_instant_of
from rtkmesh.rtk.asked_odds import DOUBLED_M
from rtkmesh.rtk.bookkeeping import Motion
from rtkmesh.rtk.calm import is_atmospheric
from rtkmesh.rtk.candidates import CandidateTable, candidate_table
from rtkmesh.rtk.complements import BaseEpochs, complemented
from rtkmesh.rtk.continuation import Continuation, carry_on, keeps_integers, obstacle
from rtkmesh.rtk.crossing import plain, renamed
from rtkmesh.rtk.ephemeris_change import are_new, change_ephemerides, learn_ephemerides, no_ephemerides
from rtkmesh.rtk.ionosphere_change import change_ionosphere
from rtkmesh.rtk.matching import census
from rtkmesh.rtk.memory import ACCEPT_AT_ONCE, new_memory
from rtkmesh.rtk.noise import new_code_scale
from rtkmesh.rtk.options import AmbiguityMode, Direction, Mode, RtkOptions
from rtkmesh.rtk.overview import Overview, overview_of
from rtkmesh.rtk.pace import Pace, Told
from rtkmesh.rtk.rate_errors import RateErrors
from rtkmesh.rtk.relative import FEW_COMMON, NOT_FINITE, SOLVED, Known, Setup, Solved, differences_of, solve
from rtkmesh.rtk.report import FIGURES, IS_FIXED, Circumstances, Moved, from_single, motion_of, report
from rtkmesh.rtk.residuals import Differences, combine
from rtkmesh.rtk.setup import setup_of
from rtkmesh.rtk.solution import Reason, SatelliteTable, Solution
from rtkmesh.rtk.standing import Standing
from rtkmesh.rtk.state import SEED_FIXED, SEED_MOVING, SEED_STANDING, Filter, FilterState, filter_at, length_m
from rtkmesh.rtk.step import ASTRAY, Step, move_on, take_step
from rtkmesh.rtk.walk import no_walk

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_DECAY_S: Final = 5.0  # accelerations of robots last seconds
_RESEED_S: Final = 4.0  # beyond this gap the motion model says nothing and the single-point position takes over
_FORGET_S: Final = 65.0  # beyond this gap nothing is left
_ABSURD_CODE_M: Final = 12.0  # no receiver's codes are that bad together: the phases carry a wrong position
_ABSURD_EPOCHS: Final = 3
_MOVING: Final = (Mode.KINEMATIC, Mode.MOVING_BASE, Mode.DGPS)
_STATIC_START: Final = Mode.STATIC_START  # members of enumerations that every epoch asks for: each look-up is 0.1 us
_REMEMBERING: Final = (AmbiguityMode.CONTINUOUS, AmbiguityMode.FIX_AND_HOLD)
_ANEW: Final = (Mode.KINEMATIC, Mode.MOVING_BASE, Mode.STATIC, Mode.STATIC_START)  # where an epoch may be solved without its past as well
_NOWHERE: Final = np.full(3, nan)
_UNKNOWN: Final = np.full((3, 3), nan)


def _motion_of(options: RtkOptions) -> Motion:
    return Motion(options.dynamics.acceleration_horizontal_mps2, options.dynamics.acceleration_vertical_mps2, _DECAY_S)


class Rtk:
    """The engine of one rover and one base. Mutable; everything else in the package is a value.

    Backward, epochs come in falling order of time and as ``reversal.Reversal`` gives them.
    """

    def __init__(self, options: RtkOptions, direction: Direction = Direction.FORWARD) -> None:
        self.options = options
        self.direction = direction
        self._sense = 1.0 if direction is Direction.FORWARD else -1.0  # of the filter's clock against GPS time
        self._state: FilterState | None = None
        self._past = Past(new_memory(), np.full(7, nan), new_code_scale(), new_code_scale(), no_walk())
        self._rates = RateErrors(), RateErrors()  # of the rover and of a moving base
        self._pace = Pace()
        self._standing = Standing()
        self._resets = 0
        self._absurd = 0
        self._was_fixed = False
        self._klobuchar: KlobucharParameters | None = None
        self._ephemerides = no_ephemerides()  # that what the filters remember was modelled with
        self._point = self._point_setup(None)
        self._use(setup_of(options))
        self._motion = _motion_of(options)
        self._bases = BaseEpochs()
        self._keeps_baseline = False  # the next base position changes what was known of the base, not the baseline
        self._single: Located | None = None
        self._satellites: SatelliteTable | None = None  # of the newest epoch, if it has a relative solution

    def antennas(self, rover: Antenna | None, base: Antenna | None) -> None:
        """Take the antennas of both ends; None where one is not known, and then neither is corrected: half a correction is worse than none.

        A change begins the filter anew, if it has ambiguities: they stand for the phase centres that were.
        """
        patterns = NO_PATTERNS if rover is None or base is None else join_patterns(rover, base)
        if np.array_equal(patterns, self._setup.antennas):
            return
        self._use(self._setup._replace(antennas=patterns))
        if self._state is None or len(self._state.filter.keys):
            self.reset()

    def _use(self, setup: Setup) -> None:
        """Take what the options say to kernels, and of modes what every epoch asks for."""
        self._setup, self._plain_setup = setup, plain(setup)
        mode = self.options.mode
        self._base_moves, self._is_fixed, self._is_static = mode is Mode.MOVING_BASE, mode is Mode.FIXED, mode is Mode.STATIC
        self._is_single, self._is_instantaneous = (
            self.options.mode is Mode.SINGLE, self.options.ambiguity.mode is AmbiguityMode.INSTANTANEOUS,
        )  # fmt: skip

    def with_other_base(self) -> "Rtk":
        """Return an engine for the same rover and another base: what does not depend on the base goes on, this engine is not changed.

        The baseline of a moving base is another one then: nothing of it goes on.
        """
        other = Rtk(self.options, self.direction)
        other._klobuchar, other._point = self._klobuchar, self._point
        other._use(self._setup)
        other._rates, other._pace = (self._rates[0].copy(), RateErrors()), self._pace.copy()
        other._resets, other._was_fixed = self._resets, self._was_fixed
        if self._state is not None and self.options.mode is not Mode.MOVING_BASE:
            sigma_m = 0.0 if self.options.mode is Mode.FIXED else float(SEED_MOVING[0])
            other._state = self._state.for_other_base(sigma_m)
        return other

    def go_on(self, options: RtkOptions) -> Continuation:
        """Take other options and keep the filter, where it can go on under them; else change nothing and say why.

        The next epoch is the first one under them. Ambiguities always stay; integers unless the way of using them is another.
        """
        now, state = self.options, self._state
        if why := obstacle(now, options, state):
            return Continuation(why)
        moved = self._moves
        self.options = options
        if options.mode is not now.mode:
            self._standing.forget()
        self._use(setup_of(options)._replace(antennas=self._setup.antennas))
        self._motion, self._point = _motion_of(options), self._point_setup(self._klobuchar)
        self._keeps_baseline = self._keeps_baseline or now.mode is Mode.MOVING_BASE is not options.mode
        if not keeps_integers(now, options):
            self._past.forget()
        return Continuation() if state is None else carry_on(state, now, options, moved=moved, moves=self._moves)

    def overview(self) -> Overview:
        """Return what is known of the newest epoch beside its solution; made when asked for."""
        return overview_of(self._state, self._single)

    def candidates(self, length: tuple[float, float] | None = None) -> CandidateTable | None:
        """Return the best integer vectors of the newest epoch; made when asked for. None where it has no relative solution.

        ``length`` (m) of the baseline and its sigma, where somebody else than these options knows it: it ranks them, and fixes nothing.
        """
        state = self._state
        if state is None or self._satellites is None or self.options.ambiguity.mode is AmbiguityMode.OFF:
            return None
        return candidate_table(state.filter, state.place, self._satellites, self._past.memory, self._past.scale, self._setup, length)

    def reset(self) -> None:
        """Forget the filter; what was learned of the code's noise stays."""
        if self._state is not None:
            self._resets += 1
        self._forget()

    def _forget(self) -> None:
        self._state = None
        self._standing.forget()
        self._past.forget()

    def step(
        self,
        rover: Epoch,
        base: Epoch | None,
        ephemerides: EphemerisTable,
        klobuchar: KlobucharParameters | None = None,
        *,
        base_position_ecef_m: Vector | None = None,
        glonass_bias: GlonassBias | None = None,  # noqa: ARG002  part of what a base says; see the docstring for why it changes nothing
        earlier_bases: Iterable[Epoch] | None = None,
        age_s: float | None = None,
    ) -> Solution:
        """Return the solution of a rover epoch with its base epoch (the same or an older one; None if there is none).

        ``base_position_ecef_m`` is the antenna of the base (not needed in moving-base mode). ``glonass_bias``
        changes nothing: a code bias that all channels share is part of the group's clock. ``earlier_bases`` are base epochs that were
        recorded before this one, newest first, for the systems that it lacks; None: those of the steps before. ``age_s`` is what the
        solution says of the base's age where that is not the difference of the tags: of an interpolated one.
        """
        if self._is_instantaneous:
            self._forget()
        before = self._point.klobuchar
        if klobuchar is not self._klobuchar:
            self._klobuchar, self._point = klobuchar, self._point_setup(klobuchar)
        issues, base_single, self._satellites = ephemerides.issues, None, None
        single = locate_epoch(rover, issues, self._point, _NOWHERE if self._state is None else self._state.rover_ecef_m)
        changes = are_new(single.rows, single.satellites, self._ephemerides), before is not self._point.klobuchar
        if changes[0] or changes[1]:
            self._change_models(rover.time, single, issues.channel, changes, before)
        self._single = single
        self._rates[0].learn(rover.time, single.quality)
        if self._is_single:
            return self._alone(rover, base, single)
        if base is not None and self._base_moves:
            base_single = locate_epoch(base, issues, self._point, _NOWHERE if base_position_ecef_m is None else base_position_ecef_m)
            self._rates[1].learn(base.time, base_single.quality)
            base_position_ecef_m = base_single.position_ecef_m if base_single.status == CONVERGED else None
            base = at_instant_of(rover, single, base, base_single, issues)
        reason = self._obstacle(rover, base, base_position_ecef_m)
        if reason is not None or base is None or base_position_ecef_m is None:
            return replace(self._alone(rover, base, single), reason=reason)
        missing, *satellites = census(rover.satellite, base.satellite)
        bases = [base]
        if not self._base_moves:
            bases = complemented(base, missing, self._bases.before(base) if earlier_bases is None else earlier_bases)
        age_s = rover.time - base.time if age_s is None else age_s
        around = Around(rover, bases, issues, (single, base_single), base_position_ecef_m, (satellites[0], satellites[1]), age_s)
        return self._doubted(self._relative(around))

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

    def _change_models(self, time: GpsTime, single: Located, channel: NDArray[np.int8], changes: tuple[bool, bool], before: Vector) -> None:
        """Let what the filters remember of phases be less the newest models: this epoch's ephemerides, Klobuchar coefficients in place of
        those ``before``; ``changes``: there are others of these, and of those.
        """
        state, known = self._state, self._ephemerides
        if state is not None:
            clock, places_ecef_m = (state.origin.week, state.origin.tow_s, self._sense), (state.rover_ecef_m, state.base_ecef_m)
            for f in (state.filter, state.informed):
                if changes[0]:
                    change_ephemerides(f, single.rows, single.satellites, known, clock, places_ecef_m)
                if changes[1]:
                    change_ionosphere(f, single, channel, (time.week, time.tow_s), places_ecef_m, before, self._point.klobuchar)
        if changes[0]:
            learn_ephemerides(single.rows, single.satellites, known)

    def _obstacle(self, rover: Epoch, base: Epoch | None, base_position_ecef_m: Vector | None) -> Reason | None:
        """Return why there can be no relative solution; None where there can."""
        if base is None:
            return Reason.NO_BASE
        limit = self.options.time_tolerance_s if self._base_moves else self.options.max_age_s
        if abs(rover.time - base.time) > limit:
            return Reason.BASE_TOO_OLD
        if base_position_ecef_m is None or not all(map(isfinite, base_position_ecef_m.tolist())):
            return Reason.NO_BASE_POSITION
        return None

    @property
    def _moves(self) -> bool:
        """Whether the rover (or the baseline) moves."""
        mode = self.options.mode
        if mode is _STATIC_START:
            return self._was_fixed or self.direction is Direction.BACKWARD
        return mode in _MOVING

    def _step_of(self, state: FilterState, around: Around) -> Step | None:
        """Return how the filters reach an epoch, None where they cannot; the state's clock and base are the epoch's then."""
        dt = self._clock_s(state, around.rover.time) - state.time_s
        if not 0.0 <= dt <= _FORGET_S:
            return None
        base_ecef_m, single, moves = state.base_ecef_m, around.singles[0], self._moves
        reseeds = moves and dt > _RESEED_S and single.status == CONVERGED
        baseline_m = length_m(single.position_ecef_m - base_ecef_m) if reseeds else state.baseline_m
        moved = around.base_ecef_m.tolist() != base_ecef_m.tolist()
        if moved:
            state.base_ecef_m, state.base_s = around.base_ecef_m.copy(), nan
        state.time_s += dt
        shifts = moved and not self._base_moves and not self._keeps_baseline
        return Step(dt, base_ecef_m, baseline_m, moves, reseeds, shifts, not self._is_fixed, self._motion)

    def _begun(self, around: Around) -> FilterState:
        """Return the state of a filter that begins with this epoch."""
        fixed = self.options.fixed_position_ecef_m if self._is_fixed else None
        start = around.singles[0].position_ecef_m if fixed is None else np.array(fixed)
        sigmas = SEED_FIXED if fixed is not None else (SEED_MOVING if self._moves else SEED_STANDING)
        witness = filter_at(start - around.base_ecef_m, sigmas)
        informed = Filter(witness.x.copy(), witness.P.copy(), witness.keys, witness.history)
        return FilterState(around.rover.time, witness, informed, base_ecef_m=around.base_ecef_m.copy())

    def _clock_s(self, state: FilterState, time: GpsTime) -> float:
        """Return an instant on the filter's clock."""
        return self._sense * (time - state.origin)

    # --- one solution ---

    def _alone(self, rover: Epoch, base: Epoch | None, single: Located) -> Solution:
        """Return the single-point solution."""
        return from_single(rover, base, single, self._rates[0].factor)

    def _relative(self, around: Around) -> Solution:
        rover, base, single = around.rover, around.bases[0], around.singles[0]
        self._past.walk.fill(nan)
        solved = self._solved_from_past(around) or self._solved_from_here(around)
        state, age_s = self._state, around.age_s
        if state is None or solved is None:
            return self._alone(rover, base, single)
        if solved.status == SOLVED and not solved.figures[IS_FIXED] and self._may_begin_anew(state, single):
            solved = self._anew(state, around) or solved
        if solved.status == FEW_COMMON:
            return replace(self._alone(rover, base, single), reason=Reason.FEW_COMMON_SATELLITES, age_s=age_s, resets=self._resets)
        if solved.status == NOT_FINITE:
            self.reset()
            return replace(self._alone(rover, base, single), reason=Reason.FILTER_RESET, age_s=age_s, resets=self._resets)
        self._was_fixed = self._was_fixed or solved.figures[IS_FIXED] > 0.0
        if self._is_static and solved.figures[IS_FIXED]:
            solved = self._stood(solved, around)
        factors = self._rates[0].factor, self._rates[1].factor
        circumstances = Circumstances(
            age_s, self._moves, self._sense, around.singles[1], factors, around.satellites, self._resets, self.options
        )
        motion = self._followed(around, solved, circumstances)
        solution = report(rover, single, around.base_ecef_m, solved, motion, circumstances)
        self._satellites = solution.satellites
        return solution

    def _stood(self, solved: Solved, around: Around) -> Solved:
        """Return a fix of a rover that stands, placed by all fixes since it does."""
        x = solved.x.copy()
        x[:3], cov_m2 = self._standing.place(around.rover.time, around.base_ecef_m, x[:3], solved.position_cov_m2[:3, :3])
        return solved._replace(x=x, position_cov_m2=cov_m2)

    def _followed(self, around: Around, solved: Solved, circumstances: Circumstances) -> Moved:
        """Return the motion with the velocity that walks and Dopplers say; of a moving base its Dopplers are among these."""
        single = around.singles[0]
        if not self._moves or self._is_instantaneous:
            return motion_of(single, solved.x, solved.P, circumstances)
        motion = motion_of(single, solved.x, solved.P, circumstances) if self._base_moves else None
        if motion is None:
            told = Told(self._past.walk, single.velocity_mps, single.velocity_cov_m2ps2, self._rates[0].factor)
        else:
            told = Told(self._past.walk, motion.velocity_mps, np.ascontiguousarray(motion.velocity_cov_m2ps2))
        followed = self._pace.follow(around.rover.time, single.clock_s, told, self._motion.horizontal_mps2, self._sense)
        if followed is None:
            return motion or motion_of(single, solved.x, solved.P, circumstances)
        return Moved(*followed, *(motion[2:] if motion else (solved.x[6:9], solved.P[6:9, 6:9])))

    def _solved_from_past(self, around: Around) -> Solved | None:
        """Return the relative solution of filters that are moved on to the epoch; None where there are none, or they must begin anew."""
        if self._state is None:
            return None
        step = self._step_of(self._state, around)
        solved = None if step is None else self._solved(self._state, self._past, around, step)
        if solved is None or solved.status == ASTRAY:
            self.reset()
            return None
        self._keeps_baseline = False
        return solved

    def _solved_from_here(self, around: Around) -> Solved | None:
        """Return the relative solution of filters that begin with the epoch; None if there is nothing to begin with."""
        if around.singles[0].status != CONVERGED and not self._is_fixed:
            return None
        self._state, self._keeps_baseline = self._begun(around), False
        return self._solved(self._state, self._past, around, self._beginning(around))

    def _beginning(self, around: Around) -> Step:
        """Return the step of filters that begin with the epoch."""
        return Step(nan, around.base_ecef_m, nan, self._moves, False, False, False, self._motion)

    def _solved(self, state: FilterState, past: Past, around: Around, step: Step, least_odds: float = -inf) -> Solved:
        """Return the relative solution of an epoch, and let state and past be what came of it; UNCLEAR where ``least_odds`` are not met."""
        base, single = around.bases[0], around.singles[0]
        base_s, channel, klobuchar = self._clock_s(state, base.time), around.issues.channel, self._point.klobuchar
        known = Known(
            np.array((state.time_s, base_s, state.rover_s, state.base_s)), state.base_ecef_m, state.rover_model_ecef_m, past.prediction,
            past.memory, past.scale, *self._velocity(around.singles), past.informed_scale, state.codes_s, past.walk, least_odds,
            not self._moves and not self._is_fixed,
        )  # fmt: skip
        step_s = state.time_s - state.rover_s
        learned = past.learned(step_s)
        if len(around.bases) == 1:
            filters, signals = (tuple(state.filter), tuple(state.informed)), (around.rover.plain_signals, base.plain_signals)
            given = tuple(single), channel, klobuchar, (*step[:-1], tuple(step.motion)), tuple(known)
            solved = renamed(take_step(filters, signals, *given, self._plain_setup))
        else:
            solved = self._solved_with_several(state, around, step, known)
        past.count_in_part(learned, step_s)
        if solved.status in (SOLVED, FEW_COMMON):
            state.filter, state.informed = solved.filter, solved.informed
            state.place = solved.place
        if solved.status == SOLVED:
            state.rover_s, state.base_s = state.time_s, base_s
        return solved

    def _solved_with_several(self, state: FilterState, around: Around, step: Step, known: Known) -> Solved:
        """Return the relative solution with several base epochs that share no system."""
        informed, moved = move_on(state.filter, state.informed, around.singles[0], step, known, self._setup)
        if not moved:
            x, P = state.filter.x, state.filter.P
            return Solved(ASTRAY, state.filter, informed, x, P, np.zeros(FIGURES), np.zeros((0, 0)), _UNKNOWN, (x, P))
        model_ecef_m = state.rover_ecef_m
        d = self._combined(state, around)
        atmospheric = is_atmospheric(length_m(state.filter.x[:3]), d.pairs.satellite)
        solved = solve(state.filter, informed, d, atmospheric, known, self._setup)
        if solved.status == SOLVED:
            state.rover_model_ecef_m[:] = model_ecef_m
        return solved

    def _may_begin_anew(self, state: FilterState, single: Located) -> bool:
        """Return whether an epoch without a fix is also looked at without its past: where the filter has one, and one epoch may resolve."""
        remembers = self.options.ambiguity.mode in _REMEMBERING and state.time_s > 0.0
        return remembers and single.status == CONVERGED and self.options.mode in _ANEW and state.baseline_m < FAR_M

    def _anew(self, state: FilterState, around: Around) -> Solved | None:
        """Solve an epoch without its past, and go on from there if its own codes and phases say clearly where it is; else None.

        After a bridge, or codes that were bad for a while, the past may be what keeps the integers from being found.
        """
        begun, past = self._begun(around), self._past.copy()
        past.forget()
        clear = ACCEPT_AT_ONCE * (1.0 + min(state.baseline_m / DOUBLED_M, 1.0))
        solved = self._solved(begun, past, around, self._beginning(around), clear)
        if solved.status != SOLVED or not solved.figures[IS_FIXED]:
            return None
        self._state, self._resets = begun, self._resets + 1
        self._past.memory[:], self._past.prediction[:] = past.memory, past.prediction
        return solved

    def _combined(self, state: FilterState, around: Around) -> Differences:
        """Form the single differences with several base epochs that share no system."""
        made = (
            differences_of(
                state.filter, around.rover.signals, part.signals, around.singles[0], around.issues.channel, self._point.klobuchar,
                state.base_ecef_m, np.array((state.time_s, self._clock_s(state, part.time))), self._setup,
            )[0]
            for part in around.bases
        )  # fmt: skip
        return reduce(combine, made)

    def _velocity(self, singles: tuple[Located, Located | None]) -> tuple[Vector, Matrix]:
        """Return the Doppler velocity relative to the base, on the filter's clock, with its covariance; NaN without."""
        rover, base = singles
        if not self._moves:
            return _NOWHERE, _UNKNOWN
        if not self._base_moves:
            return rover.velocity_mps if self._sense > 0.0 else -rover.velocity_mps, rover.velocity_cov_m2ps2
        if base is None:
            return _NOWHERE, _UNKNOWN
        return self._sense * (rover.velocity_mps - base.velocity_mps), rover.velocity_cov_m2ps2 + base.velocity_cov_m2ps2
