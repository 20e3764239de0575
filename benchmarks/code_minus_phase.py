"""Errors of one receiver's codes by code minus phase, free of the ionosphere by two bands."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from error_series import Collected, Series
from pair_errors import ephemerides
from rtkmesh.codecs.messages import Message
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM, band_of, carrier_hz
from rtkmesh.models.geometry import ELEVATION
from rtkmesh.models.single import SinglePointOptions, locate, point_setup

_SHORTEST_ARC_S: Final = 120.0
_LONGEST_GAP_S: Final = 31.0
_JUMP_M: Final = 0.1  # of the ionosphere between epochs: a slip
_L1_HZ: Final = 1575.42e6


def of_receiver(epochs: Sequence[Epoch], navigation: Sequence[Message]) -> list[Series]:
    """Return the codes' errors by code minus phase, about the mean of each arc."""
    table, point = ephemerides(navigation), point_setup(SinglePointOptions())
    collected, arcs, position = Collected(), Arcs(), np.full(3, np.nan)
    for epoch in epochs:
        located = locate(epoch.signals, table.issues, point, position)
        position = located.position_ecef_m
        elevation = dict(zip(located.satellites.tolist(), located.geometry[:, ELEVATION].tolist(), strict=True))
        time_s, rows = epoch.time - epochs[0].time, _two_bands(epoch)
        for first, second, ionosphere_m in rows:
            satellite = int(epoch.satellite[first])
            begun = arcs.begun(satellite, time_s, ionosphere_m, slipped=bool((epoch.flags[first] | epoch.flags[second]) & SLIP))
            for place, row in enumerate((first, second)):
                error_m = epoch.pseudorange_m[row] - _length_m(epoch, row) - 2.0 * _relative(epoch, row) * ionosphere_m
                key = (begun * SATELLITES_PER_SYSTEM * 8 + satellite) * 2 + place
                collected.add(time_s, [key], np.array([elevation.get(satellite, np.nan)]), np.array([error_m]))
    return [s.without_mean() for s in collected.series() if s.time_s[-1] - s.time_s[0] >= _SHORTEST_ARC_S]


@dataclass(slots=True)
class Arcs:
    """Which arc of a satellite's phases an epoch belongs to."""

    last: dict[int, tuple[int, float, float]] = field(default_factory=dict[int, tuple[int, float, float]])

    def begun(self, satellite: int, time_s: float, ionosphere_m: float, *, slipped: bool) -> int:
        """Return the arc's number; another where the receiver says so, after a gap, or where the bands move apart."""
        number, last_s, last_m = self.last.get(satellite, (0, -np.inf, 0.0))
        if slipped or time_s - last_s > _LONGEST_GAP_S or abs(ionosphere_m - last_m) > _JUMP_M:
            number += 1
        self.last[satellite] = number, time_s, ionosphere_m
        return number


def _two_bands(epoch: Epoch) -> Iterator[tuple[int, int, float]]:
    """Yield, per satellite with two bands, the rows of a signal of each and the ionosphere's delay (m, on L1's frequency, with cycles)."""
    whole = np.isfinite(epoch.pseudorange_m) & np.isfinite(epoch.phase_cyc) & (epoch.flags & HALF_CYCLE == 0)
    for satellite in np.unique(epoch.satellite[whole]).tolist():
        rows = np.flatnonzero(whole & (epoch.satellite == satellite)).tolist()
        others = [row for row in rows if band_of(int(epoch.signal[row])) != band_of(int(epoch.signal[rows[0]]))]
        if others and _relative(epoch, rows[0]) > 0.0:
            first, second = rows[0], others[0]
            yield first, second, (_length_m(epoch, first) - _length_m(epoch, second)) / (_relative(epoch, second) - _relative(epoch, first))


def _carrier_hz(epoch: Epoch, row: int) -> float:
    return carrier_hz(int(epoch.satellite[row]), int(epoch.signal[row]), int(epoch.channel[row]))


def _length_m(epoch: Epoch, row: int) -> float:
    """Return a phase in metres."""
    carrier = _carrier_hz(epoch, row)
    return float(epoch.phase_cyc[row]) * SPEED_OF_LIGHT_MPS / carrier if carrier > 0.0 else float("nan")


def _relative(epoch: Epoch, row: int) -> float:
    """Return the ionosphere's delay of a signal relative to L1's."""
    carrier = _carrier_hz(epoch, row)
    return (_L1_HZ / carrier) ** 2 if carrier > 0.0 else 0.0
