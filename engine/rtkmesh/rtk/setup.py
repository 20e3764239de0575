"""An engine's options as its kernels take them."""

from rtkmesh.models.antenna import NO_PATTERNS
from rtkmesh.rtk.integrity import IntegritySetup
from rtkmesh.rtk.matching import matching_rules
from rtkmesh.rtk.memory import resolve_setup
from rtkmesh.rtk.options import AmbiguityMode, Mode, RtkOptions
from rtkmesh.rtk.relative import Setup
from rtkmesh.rtk.slips import SlipSetup


def setup_of(options: RtkOptions) -> Setup:
    """Return the options for kernels; the antennas are not known yet."""
    moving_base, slip, noise, ambiguity = options.mode is Mode.MOVING_BASE, options.slip, options.noise, options.ambiguity
    return Setup(
        matching_rules(options.systems, options.frequencies, options.excluded, options.cn0_mask_dbhz),
        SlipSetup(slip.time_difference_cyc, slip.maximum_gap_s, moving_base, True),
        resolve_setup(ambiguity, options.baseline_length_m if moving_base else None, options.baseline_sigma_m),
        _integrity_setup(options),
        noise.phase_a_m, noise.phase_b_m, noise.code_ratio, noise.ephemeris_m_per_m, options.elevation_mask_rad,
        ambiguity.elevation_mask_rad, float(ambiguity.minimum_lock_epochs), options.dynamics.ambiguity_cyc, options.mode is not Mode.DGPS,
        ambiguity.mode is not AmbiguityMode.OFF, ambiguity.failure_rate, NO_PATTERNS, ambiguity.mode is AmbiguityMode.INSTANTANEOUS,
    )  # fmt: skip


def _integrity_setup(options: RtkOptions) -> IntegritySetup:
    independent = options.ambiguity.mode is not AmbiguityMode.FIX_AND_HOLD
    return IntegritySetup(options.integrity.enabled, options.integrity.risk, independent)
