"""Epochs for the round trips of receivers' logs: any of the signals that a maker numbers, with plausible values."""

from collections.abc import Mapping
from math import nan
from typing import Any

import numpy as np
from hypothesis import strategies as st

from rtkmesh.codecs.unicore_signals import SATELLITES
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import HALF_CYCLE, Epoch, make_epoch
from rtkmesh.gnss.signals import GLONASS, NO_CHANNEL, SATELLITES_PER_SYSTEM, carrier_hz, signal_number
from rtkmesh.gnss.time import GpsTime

TIME = GpsTime(2419, 132572.0)


def every_signal(signals: Mapping[int, Mapping[int, str]]) -> list[tuple[int, int]]:
    """Return (satellite, signal) of everything that a maker has a number for, with the first and last satellite of each system."""
    return sorted(
        {
            (system * SATELLITES_PER_SYSTEM + prn - offset, signal_number(code))
            for number, system, first, last, offset in SATELLITES
            for prn in (first, last)
            for code in signals[number].values()
        }
    )


@st.composite
def epochs(draw: st.DrawFn, signals: list[tuple[int, int]], *, half_cycles: bool = False) -> Epoch:
    """Return an epoch; some rows have no phase, no pseudorange or (where the log tells it) an open half cycle."""
    chosen = draw(st.lists(st.sampled_from(signals), min_size=1, max_size=12, unique=True))
    count = len(chosen)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    satellite, signal = (np.array([pair[k] for pair in chosen]) for k in (0, 1))
    channel = np.where(satellite // SATELLITES_PER_SYSTEM == GLONASS, rng.integers(-7, 7, count), NO_CHANNEL)
    pseudorange_m = rng.uniform(1.8e7, 4.2e7, count)
    carriers = [carrier_hz(int(a), int(b), int(c)) for a, b, c in zip(satellite, signal, channel, strict=True)]
    phase_cyc = pseudorange_m * np.array(carriers) / SPEED_OF_LIGHT_MPS + rng.uniform(-500.0, 500.0, count)
    phase_cyc = np.where(rng.random(count) < 0.9, phase_cyc, nan)
    is_open = np.isfinite(phase_cyc) & (rng.random(count) < 0.2) & half_cycles
    columns: dict[str, Any] = {
        "pseudorange_m": np.where(rng.random(count) < 0.9, pseudorange_m, nan), "phase_cyc": phase_cyc,
        "doppler_hz": np.where(np.isfinite(phase_cyc), rng.uniform(-9e3, 9e3, count), nan), "cn0_dbhz": rng.uniform(20.0, 51.0, count),
        "lock_s": rng.uniform(1.0, 6e4, count), "pseudorange_sigma_m": rng.uniform(0.05, 9.0, count),
        "phase_sigma_cyc": rng.uniform(0.001, 0.05, count), "flags": np.where(is_open, HALF_CYCLE, 0),
    }  # fmt: skip
    return make_epoch(TIME, satellite=satellite, signal=signal, channel=channel, **columns)


def check_epoch(found: Epoch, sent: Epoch, steps: Mapping[str, float]) -> None:
    """Hold a decoded epoch against what was sent; ``steps`` are the resolutions by column."""
    for name in ("satellite", "signal", "channel", "flags"):
        assert getattr(found, name).tolist() == getattr(sent, name).tolist()
    for name, step in steps.items():
        np.testing.assert_allclose(getattr(found, name), getattr(sent, name), rtol=0.0, atol=step, equal_nan=True, err_msg=name)
