"""Options of the engine, with units, defaults and the reason for each default. Angles in radians."""

from dataclasses import dataclass, field
from enum import StrEnum
from math import radians
from typing import Final

from rtkmesh.errors import OptionError

# Of unknown length; with fewer, what passes a ratio of 3 is wrong more often than right: 81 % of four, 97 % of three ambiguities of single
# epochs of a recorded pair (benchmarks/attitude_subsets.py measures it on our engine).
LEAST_AMBIGUITIES: Final = 5


class Mode(StrEnum):
    """What is known of the receivers' motion (RTKLIB's names)."""

    SINGLE = "single"
    DGPS = "dgps"
    STATIC = "static"
    STATIC_START = "static-start"
    KINEMATIC = "kinematic"
    MOVING_BASE = "moving-base"
    FIXED = "fixed"


class Direction(StrEnum):
    """Which way an engine goes through the epochs."""

    FORWARD = "forward"
    BACKWARD = "backward"


class AmbiguityMode(StrEnum):
    """How integer ambiguities are used from one epoch to the next."""

    OFF = "off"
    INSTANTANEOUS = "instantaneous"
    CONTINUOUS = "continuous"
    FIX_AND_HOLD = "fix-and-hold"


@dataclass(frozen=True, slots=True)
class NoiseOptions:
    """Measurement noise: sigma^2 = a^2 + (b / sin elevation)^2 for phase, times ``code_ratio``^2 for code."""

    phase_a_m: float = 0.003  # RTKLIB stats-errphase
    phase_b_m: float = 0.003  # RTKLIB stats-errphaseel
    code_ratio: float = 150.0  # 0.6 m at the zenith, between survey (0.2) and patch antennas (1 to 3): learned from residuals
    ephemeris_m_per_m: float = 0.1e-6  # broadcast orbit error of 2 m over the baseline: 0.1 mm per km


@dataclass(frozen=True, slots=True)
class DynamicsOptions:
    """Process noise of the moving states (per square root of second)."""

    # By so much a step, a brake or a turn changes the acceleration within a second, vertically by half of it. RTKLIB's default is 10,
    # demo5's files say 3 and 1.
    acceleration_horizontal_mps2: float = 3.0
    acceleration_vertical_mps2: float = 1.5
    ambiguity_cyc: float = 4e-3  # coloured code noise must not freeze the float (with 1e-4 the float stays wrong and sure of it)


@dataclass(frozen=True, slots=True)
class SlipOptions:
    """Cycle slip tests."""

    time_difference_cyc: float = 0.35  # a slip is 0.5 or more; the test's own noise is below 0.1
    maximum_gap_s: float = 20.0  # ambiguities are kept over outages up to this


@dataclass(frozen=True, slots=True)
class AmbiguityOptions:
    """Integer ambiguity resolution and validation."""

    mode: AmbiguityMode = AmbiguityMode.CONTINUOUS
    ratio: float = 3.0  # scales the confidence asked for: 3 is our default, 2 asks for less, 4 for more (validation.confidence)
    elevation_mask_rad: float = radians(15.0)  # that of the filter: what is low is weighted by its elevation
    minimum_lock_epochs: int = 0  # an ambiguity that begins has the variance of its code, and the odds know it
    minimum_ambiguities: int = LEAST_AMBIGUITIES
    hold_variance_cyc2: float = 0.1  # RTKLIB's varholdamb: a third of a cycle, so that a float solution can still object
    hold_after_epochs: int = 20  # confirmations before fix-and-hold tells the filter: as many as minfix in demo5's files
    failure_rate: float = 1.0  # fixes that are wrong with a higher probability are given as floats; 1: none (docs/concepts/integrity.md)

    def __post_init__(self) -> None:
        if not 0.0 < self.failure_rate <= 1.0:
            raise OptionError(f"failure rate is {self.failure_rate}, must be above 0 and at most 1")


@dataclass(frozen=True, slots=True)
class IntegrityOptions:
    """Protection levels and the integrity flag: see docs/concepts/integrity.md."""

    enabled: bool = True
    # Per epoch, that the position is off by more than its protection levels: nothing smaller can be contradicted by the 1e5 epochs of the
    # campaigns that there are.
    risk: float = 1e-5
    # Our choice, a robot's own size: of simulated fixes on two bands under open sky 98 % are within it, of floats none.
    alert_horizontal_m: float = 1.0
    alert_vertical_m: float = 2.0  # heights are about twice as bad

    def __post_init__(self) -> None:
        if not 1e-12 <= self.risk <= 0.1:
            raise OptionError(f"integrity risk is {self.risk}, must be 1e-12 to 0.1")
        if not (self.alert_horizontal_m > 0.0 and self.alert_vertical_m > 0.0):
            raise OptionError("alert limits must be above 0 m")


@dataclass(frozen=True, slots=True)
class RtkOptions:
    """Everything that a solver instance can be told.

    ``systems`` are RINEX letters; ``frequencies`` is the number of carrier bands used per satellite; ``max_age_s`` the
    largest age of a base epoch; ``baseline_length_m`` and its sigma constrain a moving base (None: unknown length);
    ``excluded`` are RINEX ids. ``code_only_systems`` never enter the integer search.
    """

    mode: Mode = Mode.KINEMATIC  # a robot moves; what does not is found as well, only later
    systems: str = "GREJC"  # those that receivers send phases of; NavIC and SBAS must be asked for
    frequencies: int = 2  # what robots' receivers have; a third takes twice the time, and two are fixed in the first epoch under open sky
    elevation_mask_rad: float = radians(15.0)  # RTKLIB's; lower down a patch antenna hears the ground as well
    cn0_mask_dbhz: float = 0.0  # none: a weak signal gets its variance by C/N0 (``noise.cn0_factor``)
    max_age_s: float = 30.0  # RTKLIB's; satellite clocks may be 4.5 cm off by then (``noise.CLOCK_DRIFT_MPS``), which the variances know
    time_tolerance_s: float = 0.025  # rover and base tags of one epoch differ by receiver clock steering
    baseline_length_m: float | None = None
    baseline_sigma_m: float = 0.01  # of a tape, centre to centre
    fixed_position_ecef_m: tuple[float, float, float] | None = None
    excluded: tuple[str, ...] = ()
    noise: NoiseOptions = field(default_factory=NoiseOptions)
    dynamics: DynamicsOptions = field(default_factory=DynamicsOptions)
    slip: SlipOptions = field(default_factory=SlipOptions)
    ambiguity: AmbiguityOptions = field(default_factory=AmbiguityOptions)
    integrity: IntegrityOptions = field(default_factory=IntegrityOptions)

    def __post_init__(self) -> None:
        if not 1 <= self.frequencies <= 5:
            raise OptionError(f"frequencies is {self.frequencies}, must be 1 to 5")
        if unknown := set(self.systems) - set("GRECJSI"):
            raise OptionError(f"systems has unknown letters {''.join(sorted(unknown))!r}; known are GRECJSI")
        if self.mode is Mode.FIXED and self.fixed_position_ecef_m is None:
            raise OptionError("mode 'fixed' needs fixed_position_ecef_m")
        if self.ambiguity.minimum_ambiguities < LEAST_AMBIGUITIES and self.baseline_length_m is None:
            count = self.ambiguity.minimum_ambiguities
            raise OptionError(f"minimum_ambiguities is {count}: fewer than {LEAST_AMBIGUITIES} are believed only with baseline_length_m")
        if self.ambiguity.failure_rate < 1.0 and not self.integrity.enabled:
            raise OptionError("a failure rate needs integrity: nothing else says how probably a fix is wrong")
