"""Receivers by class, with the errors that recordings of the kind show: ``benchmarks/receiver_errors.py`` measures both alike.

- SURVEY: the mean of three pairs of survey receivers (mosaic-X5, PolaRx5 with NetR9, Trimble 5700), 1 m to 3 km apart.
- M8: two M8P against each other and one of them against a survey receiver, in one place.
- F9P: codes by code minus phase of six static logs of a ZED-F9P; phases by their difference between bands, for there is no recorded pair.
"""

from math import radians
from typing import Final

from rtkmesh.simulation.receiver import ReceiverOptions
from rtkmesh.simulation.tracking import SignalOptions

# Geodetic receiver and antenna with ground plane; its formats (RTCM 3, RINEX) say nothing of sigmas.
SURVEY: Final = ReceiverOptions(
    signals=SignalOptions(
        code_sigma_m=0.09, phase_sigma_m=0.0009, code_multipath_m=0.155, phase_multipath_m=0.0013, code_slow=0.38, code_lasting=0.11,
        phase_slow=0.27, phase_lasting=0.68, multipath_fast_s=12.0, multipath_slow_s=60.0, glonass_code_bias_m=0.5, told_code_sigma_m=0.0,
        slips_per_hour=0.2, zenith_cn0_dbhz=51.0, horizon_cn0_dbhz=33.0, second_signal_db=-3.0, half_cycle_share=0.0,
        half_cycle_time_s=0.0,
    ),
    elevation_mask_rad=radians(5.0),
    clock_drift=2e-8,
)  # fmt: skip
# Like a u-blox ZED-F9P with a dual-band patch on a small ground plane.
F9P: Final = ReceiverOptions(signals=SignalOptions(), clock_drift=3.1e-7)
# Like a u-blox NEO-M8P or M8T with a single-band patch: codes about twice as noisy, two systems.
M8: Final = ReceiverOptions(
    signals=SignalOptions(
        code_sigma_m=0.1, phase_sigma_m=0.0014, code_multipath_m=0.52, phase_multipath_m=0.0025, code_slow=0.08, code_lasting=0.08,
        phase_slow=0.27, phase_lasting=0.18, multipath_fast_s=22.0, multipath_slow_s=90.0, told_code_sigma_m=0.3, slips_per_hour=2.0,
        zenith_cn0_dbhz=50.0, horizon_cn0_dbhz=34.0, rate_sigma_mps=0.05,
    ),
    clock_drift=-5.3e-7,
    systems="GR",
    frequencies=1,
)  # fmt: skip


def moving(signals: SignalOptions, multipath_s: float) -> SignalOptions:
    """Return a receiver's signals on a vehicle: all of its multipath is gone within a time, and none is lasting."""
    fast_s, slow_s = min(signals.multipath_fast_s, multipath_s), min(signals.multipath_slow_s, multipath_s)
    return signals._replace(multipath_fast_s=fast_s, multipath_slow_s=slow_s, code_lasting=0.0, phase_lasting=0.0)
