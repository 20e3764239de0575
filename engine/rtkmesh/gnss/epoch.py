"""Observations of one receiver at one instant, as columns."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.signals import NO_CHANNEL, SIGNALS_PER_SATELLITE, satellite_id, signal_code
from rtkmesh.gnss.time import GpsTime

# Bits of Epoch.flags.
SLIP: Final = 1  # the receiver says that the phase slipped since the last epoch (RINEX LLI bit 0)
HALF_CYCLE: Final = 2  # the half-cycle ambiguity is not resolved (RINEX LLI bit 1, UBX trkStat, MSM DF420)

# (column, dtype, value where it is not known)
COLUMNS: Final = (
    ("satellite", np.int16, 0),
    ("signal", np.int16, 0),
    ("channel", np.int8, NO_CHANNEL),
    ("flags", np.uint8, 0),
    ("pseudorange_m", np.float64, np.nan),
    ("phase_cyc", np.float64, np.nan),
    ("doppler_hz", np.float64, np.nan),
    ("cn0_dbhz", np.float64, np.nan),
    ("lock_s", np.float64, np.nan),
    ("pseudorange_sigma_m", np.float64, np.nan),
    ("phase_sigma_cyc", np.float64, np.nan),
)


class Signals(NamedTuple):
    """The columns of an epoch as kernels take them, with its time tag (GPST week and seconds of week)."""

    week: int
    tow_s: float
    satellite: NDArray[np.int16]
    signal: NDArray[np.int16]
    channel: NDArray[np.int8]
    flags: NDArray[np.uint8]
    pseudorange_m: NDArray[np.float64]
    phase_cyc: NDArray[np.float64]
    doppler_hz: NDArray[np.float64]
    cn0_dbhz: NDArray[np.float64]
    lock_s: NDArray[np.float64]
    pseudorange_sigma_m: NDArray[np.float64]
    phase_sigma_cyc: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """One epoch of one receiver: one row per satellite and signal, sorted by (satellite, signal), no row twice.

    ``time`` is the receiver's own time tag in GPST. All columns have the same length. A value that was not observed is NaN:
    ``pseudorange_m``, ``phase_cyc`` (RINEX sign: grows with range), ``doppler_hz`` (RINEX sign: positive when approaching),
    ``cn0_dbhz``, ``lock_s`` (continuous phase tracking, at least), ``pseudorange_sigma_m`` and ``phase_sigma_cyc`` (as
    reported by the receiver). ``channel`` is the GLONASS frequency number, ``NO_CHANNEL`` where there is none.
    """

    time: GpsTime
    satellite: NDArray[np.int16]
    signal: NDArray[np.int16]
    channel: NDArray[np.int8]
    flags: NDArray[np.uint8]
    pseudorange_m: NDArray[np.float64]
    phase_cyc: NDArray[np.float64]
    doppler_hz: NDArray[np.float64]
    cn0_dbhz: NDArray[np.float64]
    lock_s: NDArray[np.float64]
    pseudorange_sigma_m: NDArray[np.float64]
    phase_sigma_cyc: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.satellite)

    @property
    def signals(self) -> Signals:
        """What kernels take."""
        return Signals(*self.plain_signals)

    @property
    def plain_signals(self) -> tuple[Any, ...]:
        """The fields of ``signals`` alone: without names they cross into a kernel sooner (rtk/crossing.py)."""
        time = self.time
        return (
            time.week, time.tow_s, self.satellite, self.signal, self.channel, self.flags, self.pseudorange_m, self.phase_cyc,
            self.doppler_hz, self.cn0_dbhz, self.lock_s, self.pseudorange_sigma_m, self.phase_sigma_cyc,
        )  # fmt: skip

    def rows(self) -> Iterator[tuple[str, str, float, float, float, float]]:
        """Yield (satellite id, signal code, pseudorange m, phase cycles, Doppler Hz, C/N0 dB-Hz) for people and tests."""
        for i in range(len(self)):
            yield (
                satellite_id(int(self.satellite[i])), signal_code(int(self.signal[i])), float(self.pseudorange_m[i]),
                float(self.phase_cyc[i]), float(self.doppler_hz[i]), float(self.cn0_dbhz[i]),
            )  # fmt: skip

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> "Epoch":
        """Return the epoch with these rows only (an index array in rising order, or a mask)."""
        columns: dict[str, Any] = {name: getattr(self, name)[index] for name, _, _ in COLUMNS}
        return Epoch(self.time, **columns)


def make_epoch(time: GpsTime, **columns: Any) -> Epoch:
    """Return an epoch from columns of any order: rows are sorted, of equal (satellite, signal) the first is kept.

    ``satellite`` and ``signal`` are needed; columns left out are filled with 'not known'.
    """
    count = len(np.atleast_1d(np.asarray(columns["satellite"])))
    full: dict[str, NDArray[Any]] = {
        name: np.ascontiguousarray(columns[name], dtype=dtype) if name in columns else np.full(count, unknown, dtype=dtype)
        for name, dtype, unknown in COLUMNS
    }
    key = full["satellite"].astype(np.int32) * SIGNALS_PER_SATELLITE + full["signal"]
    _, index = np.unique(key, return_index=True)
    kept: dict[str, Any] = {name: column[index] for name, column in full.items()}
    return Epoch(time, **kept)
