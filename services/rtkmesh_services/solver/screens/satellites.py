"""The words ``satellite`` and ``observ``: a row per satellite, by RTKRCV's slots of frequencies."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import degrees, isfinite
from typing import Any, Final

import numpy as np

from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import SYSTEMS, satellite_id, signal_code
from rtkmesh.rtk.matching import BANDS
from rtkmesh.rtk.overview import Overview
from rtkmesh.rtk.solution import FIXED, USED_CODE, USED_PHASE, Solution
from rtkmesh_schemas.command import plain
from rtkmesh_services.mapping.solution import satellites_message
from rtkmesh_services.texts.times import calendar, instant

SLOTS: Final = ("L1", "L2", "L5", "L6", "L7")


def slot_of(satellite: str, signal: str) -> int | None:
    """Return RTKRCV's slot of a signal: the place of its band among those of the system; None for a band that is never used."""
    place = BANDS[satellite[0]].find(signal[:1])
    return place if 0 <= place < len(SLOTS) else None


@dataclass(slots=True)
class _Slot:
    """What the filter made of one satellite's signal in a slot."""

    used: bool = False
    fix: str = "-"
    code_residual_m: float = 0.0
    phase_residual_m: float = 0.0
    slips: int = 0
    lock_epochs: int = 0
    rejects: int = 0


@dataclass(slots=True)
class _Row:
    satellite: str
    azimuth_deg: float
    elevation_deg: float
    code_used: bool
    slots: dict[int, _Slot] = field(default_factory=dict[int, "_Slot"])


def satellites_screen(solution: Solution | None, overview: Overview, count: int, *, holds: bool) -> str:
    """Return the satellites above the horizon with ``count`` slots; ``holds``: held integers are told to the filter."""
    rows = _rows(solution, overview, holds=holds)
    return _header(count) + "".join(f"{_line(row, count)}\n" for row in rows if row.elevation_deg > 0.0)


def satellites_data(solution: Solution | None, overview: Overview, source: str) -> dict[str, Any]:
    """Return the satellites with a code, and what the filter made of their signals (the columns of the key ``sat``)."""
    return {
        "satellite": [satellite_id(number) for number in overview.satellite.tolist()],
        "azimuth_deg": np.degrees(overview.azimuth_rad).tolist(),
        "elevation_deg": np.degrees(overview.elevation_rad).tolist(),
        "code_used": overview.code_used.tolist(),
        "code_residual_m": overview.code_residual_m.tolist(),
        "signals": {} if solution is None else plain(satellites_message(solution, source)),
    }


def _header(count: int) -> str:
    names = SLOTS[:count]
    digits = [name[1] for name in names]
    columns = [
        *(f" {name}" for name in names), *(f"  Fix{d}" for d in digits), *(f"  P{d}Res" for d in digits), *(f"   L{d}Res" for d in digits),
        *(f"  Sl{d}" for d in digits), *(f"  Lock{d}" for d in digits), *(f" Rj{d}" for d in digits),
    ]  # fmt: skip
    return f"SAT C1    Az   El{''.join(columns)}\n"


def _line(row: _Row, count: int) -> str:
    slots = [row.slots.get(place, _Slot()) for place in range(count)]
    parts = [
        f"{row.satellite:>3s} {'OK' if row.code_used else '-':>2s} {row.azimuth_deg:5.1f} {row.elevation_deg:4.1f}",
        *(f" {'OK' if slot.used else '-':>2s}" for slot in slots), *(f" {slot.fix:>5s}" for slot in slots),
        *(f"{slot.code_residual_m:7.3f}" for slot in slots), *(f"{slot.phase_residual_m:8.4f}" for slot in slots),
        *(f"{slot.slips:5d}" for slot in slots), *(f"{slot.lock_epochs:7d}" for slot in slots), *(f"{slot.rejects:4d}" for slot in slots),
    ]  # fmt: skip
    return "".join(parts)


def _rows(solution: Solution | None, overview: Overview, *, holds: bool) -> Iterable[_Row]:
    rows: dict[int, _Row] = {}
    columns = (overview.satellite, overview.azimuth_rad, overview.elevation_rad, overview.code_used, overview.code_residual_m)
    for number, azimuth_rad, elevation_rad, used, residual_m in zip(*(column.tolist() for column in columns), strict=True):
        row = rows[number] = _Row(satellite_id(number), degrees(azimuth_rad), degrees(elevation_rad), used)
        row.slots[0] = _Slot(code_residual_m=finite(residual_m))
    if solution is not None:
        _add_signals(rows, solution, holds=holds)
    return [rows[number] for number in sorted(rows)]


def _add_signals(rows: dict[int, _Row], solution: Solution, *, holds: bool) -> None:
    """Add what a relative solution says of signals; it goes before what the single point says."""
    table = solution.satellites
    names = (
        "satellite",
        "signal",
        "state",
        "azimuth_rad",
        "elevation_rad",
        "code_residual_m",
        "phase_residual_m",
        "slips",
        "lock_epochs",
        "rejects",
    )
    for number, signal, state, azimuth_rad, elevation_rad, code_m, phase_m, *counts in zip(
        *(getattr(table, name).tolist() for name in names), strict=True
    ):
        name = satellite_id(number)
        row = rows.setdefault(number, _Row(name, degrees(azimuth_rad), degrees(elevation_rad), bool(state & USED_CODE)))
        place = slot_of(name, signal_code(signal))
        if place is not None:
            row.slots[place] = _Slot(bool(state & USED_PHASE), _fix(state, holds=holds), finite(code_m), finite(phase_m), *counts)


def _fix(state: int, *, holds: bool) -> str:
    if not state & USED_PHASE:
        return "-"
    return ("HOLD" if holds else "FIX") if state & FIXED else "FLOAT"


def finite(value: float) -> float:
    """Return a number, 0 where it is not known: RTKRCV's screens have no other way to say so."""
    return value if isfinite(value) else 0.0


def observations_screen(epochs: Mapping[int, Epoch], count: int) -> str:
    """Return the newest epochs of rover (1) and base (2), a row per satellite with ``count`` slots."""
    names = SLOTS[:count]
    head = "".join((
        *(f"{f'P{name[1]}(m)':>13s}" for name in names), *(f"{f'L{name[1]}(cyc)':>14s}" for name in names),
        *(f"  D{name[1]}(Hz)" for name in names), *(f" S{name[1]}" for name in names),
    ))  # fmt: skip
    rows = [line for receiver, epoch in sorted(epochs.items()) for line in _observed(receiver, epoch, count)]
    return f"      TIME(GPST)       SAT R{head} LLI\n" + "".join(f"{line}\n" for line in rows)


def _observed(receiver: int, epoch: Epoch, count: int) -> Iterable[str]:
    time = calendar(instant(epoch.time.week, epoch.time.tow_s), 2)
    by_satellite: dict[str, dict[int, int]] = {}
    for k, (satellite, signal) in enumerate(zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True)):
        name = satellite_id(satellite)
        place = slot_of(name, signal_code(signal))
        if place is not None:
            by_satellite.setdefault(name, {}).setdefault(place, k)
    for name, slots in sorted(by_satellite.items(), key=lambda item: (SYSTEMS.index(item[0][0]), item[0])):
        yield f"{time} {name:>3s} {receiver}" + _values(epoch, [slots.get(place) for place in range(count)])


def _values(epoch: Epoch, rows: list[int | None]) -> str:
    def of(column: Any) -> list[float]:
        return [0.0 if k is None else finite(float(column[k])) for k in rows]

    return "".join((
        *(f" {value:12.3f}" for value in of(epoch.pseudorange_m)), *(f" {value:13.3f}" for value in of(epoch.phase_cyc)),
        *(f" {value:7.1f}" for value in of(epoch.doppler_hz)), *(f" {value:2.0f}" for value in of(epoch.cn0_dbhz)),
        *(f"{value:2.0f}" for value in of(epoch.flags)),
    ))  # fmt: skip


def observations_data(epoch: Epoch) -> dict[str, Any]:
    """Return the columns of an epoch, one entry per satellite and signal."""
    return {
        "week": epoch.time.week,
        "tow_s": epoch.time.tow_s,
        "satellite": [satellite_id(number) for number in epoch.satellite.tolist()],
        "signal": [signal_code(number) for number in epoch.signal.tolist()],
        **{name: getattr(epoch, name).tolist() for name in ("pseudorange_m", "phase_cyc", "doppler_hz", "cn0_dbhz", "lock_s", "flags")},
    }
