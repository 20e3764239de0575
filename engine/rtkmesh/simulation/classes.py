"""Receivers by class. Sigmas are at 45 dB-Hz; all of them are our choice, of the size that recordings of the kind show."""

from math import radians
from typing import Final

from rtkmesh.simulation.receiver import ReceiverOptions
from rtkmesh.simulation.tracking import SignalOptions

# Geodetic receiver and antenna with ground plane.
SURVEY: Final = ReceiverOptions(
    signals=SignalOptions(
        code_sigma_m=0.15, phase_sigma_m=0.0008, code_multipath_m=0.3, phase_multipath_m=0.002, slips_per_hour=0.2, zenith_cn0_dbhz=51.0,
        half_cycle_share=0.0, half_cycle_time_s=0.0,
    ),
    elevation_mask_rad=radians(5.0),
    clock_drift=2e-8,
)  # fmt: skip
# Like a u-blox ZED-F9P with a dual-band patch on a small ground plane.
F9P: Final = ReceiverOptions(signals=SignalOptions(), clock_drift=3.1e-7)
# Like a u-blox NEO-M8P or M8T with a single-band patch: codes about twice as noisy, two systems.
M8: Final = ReceiverOptions(
    signals=SignalOptions(
        code_sigma_m=0.45, phase_sigma_m=0.0015, code_multipath_m=1.3, phase_multipath_m=0.004, slips_per_hour=2.0, zenith_cn0_dbhz=47.0,
        horizon_cn0_dbhz=31.0, rate_sigma_mps=0.05,
    ),
    clock_drift=-5.3e-7,
    systems="GR",
    frequencies=1,
)  # fmt: skip
