"""Conversions to RINEX compared observation by observation: what two files hold alike, what only one of them holds, what differs.

Values are alike within the last printed digit; strengths within the quarter of a dB-Hz that convbin keeps.
"""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.gnss.ephemeris import Ephemeris, KeplerEphemeris
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import satellite_id, signal_code

# column -> how far values may be apart: half of the last digit of either file, and what convbin keeps of Dopplers and strengths
TOLERANCES: Final = {"pseudorange_m": 0.00101, "phase_cyc": 0.00101, "doppler_hz": 0.00151, "cn0_dbhz": 0.1261}
_RELATIVE: Final = 2e-11  # of numbers with twelve decimals
_EXAMPLES: Final = 8


@dataclass(slots=True)
class Comparison:
    """Counts of what two observation files hold. ``examples`` names some of each kind of difference."""

    counts: Counter[str] = field(default_factory=Counter[str])
    largest: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TOLERANCES, 0.0))
    examples: dict[str, list[str]] = field(default_factory=dict[str, list[str]])

    def note(self, kind: str, count: int, example: str = "") -> None:
        """Count a difference."""
        if count:
            self.counts[kind] += count
            if example and len(self.examples.setdefault(kind, [])) < _EXAMPLES:
                self.examples[kind].append(example)

    @property
    def exact(self) -> bool:
        """Whether every value of either file is in the other one, alike."""
        return not any(count for kind, count in self.counts.items() if kind.startswith(("value", "only", "epochs only")))


def compare_observations(ours: Path, theirs: Path) -> Comparison:
    """Compare the epochs of two RINEX observation files."""
    a, b = (_by_time(path) for path in (ours, theirs))
    result = Comparison()
    result.counts["epochs"] = len(a.keys() & b.keys())
    for kind, only in (("epochs only ours", sorted(a.keys() - b.keys())), ("epochs only theirs", sorted(b.keys() - a.keys()))):
        result.note(kind, len(only), str(only[:3]))
    for key in sorted(a.keys() & b.keys()):
        _compare_epochs(a[key], b[key], result)
    return result


def _by_time(path: Path) -> dict[float, Epoch]:
    """Return the epochs by time of week (a log without date may be put into different weeks)."""
    return {round(epoch.time.tow_s, 3): epoch for epoch in ObservationReader(path.read_bytes())} if path.is_file() else {}


def _compare_epochs(a: Epoch, b: Epoch, result: Comparison) -> None:
    keys = [epoch.satellite.astype(np.int64) * 512 + epoch.signal for epoch in (a, b)]
    _, i, j = np.intersect1d(*keys, return_indices=True)
    for side, epoch, common in (("ours", a, i), ("theirs", b, j)):
        for row in np.setdiff1d(np.arange(len(epoch)), common):
            values = int(sum(np.isfinite(getattr(epoch, name)[row]) for name in TOLERANCES))
            result.note(f"only {side}: {_label(epoch, row)[0]} {_label(epoch, row)[3:]}", values, _place(epoch, row))
    for name, tolerance in TOLERANCES.items():
        _compare_values(a, b, i, j, name, tolerance, result)
    tracked = np.isfinite(a.phase_cyc[i]) & np.isfinite(b.phase_cyc[j])
    for bit, label in ((SLIP, "slip"), (HALF_CYCLE, "half cycle")):
        x, y = ((epoch.flags[rows] & bit > 0) & tracked for epoch, rows in ((a, i), (b, j)))
        result.counts[f"flag {label} alike"] += int((x & y).sum())
        for side, only in (("ours", x & ~y), ("theirs", y & ~x)):
            for row in np.flatnonzero(only):
                result.note(f"flag {label} only {side}", 1, _place(a, int(i[row])))


def _compare_values(a: Epoch, b: Epoch, i: NDArray[np.intp], j: NDArray[np.intp], name: str, tolerance: float, result: Comparison) -> None:
    x, y = getattr(a, name)[i], getattr(b, name)[j]
    both = np.isfinite(x) & np.isfinite(y)
    gap = np.abs(x - y)
    alike = both & (gap <= tolerance)
    result.counts[f"{name} alike"] += int(alike.sum())
    result.largest[name] = max(result.largest[name], float(gap[both].max(initial=0.0)))
    for row in np.flatnonzero(both & ~alike):
        result.note(f"value {name}", 1, f"{_place(a, int(i[row]))} {x[row]:.3f} {y[row]:.3f}")
    for side, only in (("ours", np.isfinite(x) & ~np.isfinite(y)), ("theirs", np.isfinite(y) & ~np.isfinite(x))):
        for row in np.flatnonzero(only):
            result.note(f"only {side}: {name}", 1, _place(a, int(i[row])))


def _label(epoch: Epoch, row: int) -> str:
    return satellite_id(int(epoch.satellite[row])) + signal_code(int(epoch.signal[row]))


def _place(epoch: Epoch, row: int) -> str:
    return f"{epoch.time.tow_s:.3f} {_label(epoch, row)}"


def compare_navigation(ours: Path, theirs: Path) -> Comparison:
    """Compare the ephemerides of two navigation files by satellite, issue and reference time."""
    a, b = (_records(path) for path in (ours, theirs))
    result = Comparison()
    result.counts["ephemerides"] = len(a.keys() & b.keys())
    for side, only in (("ours", a.keys() - b.keys()), ("theirs", b.keys() - a.keys())):
        for key in sorted(only):
            result.note(f"only {side}: ephemerides {key[0][0]}", 1, str(key))
    for key in a.keys() & b.keys():
        for name in differing(a[key], b[key]):
            result.note(f"value {key[0][0]} {name}", 1, f"{key} {getattr(a[key], name)} {getattr(b[key], name)}")
    return result


def _records(path: Path) -> dict[tuple[Any, ...], Ephemeris]:
    if not path.is_file():
        return {}
    return {
        (satellite_id(e.satellite), e.message.name if isinstance(e, KeplerEphemeris) else "FDMA", e.iode, e.toe.tow_s): e
        for e in read_navigation(path.read_bytes()).ephemerides
    }


def differing(a: Ephemeris, b: Ephemeris) -> list[str]:
    """Return the fields in which two ephemerides differ by more than their printed digits."""
    return [name for name in type(a).__dataclass_fields__ if not _same(getattr(a, name), getattr(b, name))]


def _same(x: Any, y: Any) -> bool:
    if isinstance(x, tuple):
        return all(map(_same, x, y))
    if isinstance(x, float):
        return abs(x - y) <= max(abs(x), abs(y)) * _RELATIVE + 1e-24
    if hasattr(x, "tow_s"):
        return abs(x.tow_s - y.tow_s) < 1e-3
    return bool(x == y)
