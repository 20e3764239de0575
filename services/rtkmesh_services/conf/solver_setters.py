"""RTKLIB's value of each key of the solver -> what it changes in our table."""

import re
from typing import Any, Final

import msgspec

from rtkmesh_schemas.config import LEAST_AMBIGUITIES, SolverTable
from rtkmesh_services.conf.changes import Change, Setter, ignored, taken, translated
from rtkmesh_services.conf.choices import Dialect
from rtkmesh_services.conf.rows import Row
from rtkmesh_services.conf.values import number_of, value_of
from rtkmesh_services.errors import ConfError
from rtkmesh_services.runtime.words import clip

SYSTEM_BITS: Final = {"G": 1, "S": 2, "R": 4, "E": 8, "J": 16, "C": 32, "I": 64}
MODES: Final = {
    "single": "single", "dgps": "dgps", "kinematic": "kinematic", "static": "static", "static-start": "static-start",
    "movingbase": "moving-base", "fixed": "fixed",
}  # fmt: skip
_SATELLITE: Final = re.compile(r"(\+?)([GRECJSI])(\d{1,3})")
_SBAS_FIRST: Final = 100
_SOLID_TIDES: Final = 1
# what is done here whatever the file says; another value alters the result
_DONE: Final = {
    "pos1-ionoopt": ("brdc",), "pos1-tropopt": ("saas", "est-ztd"), "pos1-sateph": ("brdc",),
    "pos2-gloarmode": ("on", "autocal", "fix-and-hold"), "pos2-bdsarmode": ("on",), "pos2-arfilter": ("on",),
}  # fmt: skip
_HARMLESS: Final = {
    "pos1-posopt1",
    "pos1-posopt3",
    "pos1-posopt2",
    "pos1-posopt4",
    "pos1-posopt5",
    "pos1-posopt6",
    "pos2-armaxiter",
    "pos2-niter",
    "stats-prnpos",
}


def change_of(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    """Return what a value changes in a solver's table; ConfError if it is none."""
    setter = _SETTERS.get(row.name)
    if setter is not None:
        return setter(table, row, text, dialect)
    value = value_of(row, text, dialect)
    if row.name in _DONE:
        return ignored(row.why, alters=value not in _DONE[row.name])
    same = value == value_of(row, row.default_of(dialect), dialect)
    return ignored(row.why, alters=not same and row.name not in _HARMLESS)


def present(table: SolverTable, path: str) -> Any:
    """Return the value of a dotted key of a solver's table."""
    value: Any = table
    for name in path.split("."):
        value = getattr(value, name)
    return value


def _plain(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    """A number or word that goes over as it is, where its place is an int as an int."""
    value = value_of(row, text, dialect)
    path = row.target.removeprefix("solver.")
    return Change(row.fate, row.why, {path: int(value) if path in _WHOLE and not isinstance(value, str) else value})


def _mode(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    name = str(value_of(row, text, dialect))
    if name not in MODES:
        raise ConfError(f"{row.name}: {name} is not there: rtkmesh has no PPP; nearest are kinematic, static and single")
    return taken("" if MODES[name] == name else f"{name} is {MODES[name]} here", mode=MODES[name])


def _frequencies(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    if text.strip() == "l1+l5":
        return translated("two bands per satellite, the best that both receivers have; not fixed to L5", frequencies=2)
    name = str(value_of(row, text, dialect))
    return taken("", frequencies=name.count("+") + 1)


def _systems(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    bits = int(number_of(row, text, dialect))
    letters = "".join(letter for letter in "GRECJSI" if bits & SYSTEM_BITS[letter])
    if not letters:
        raise ConfError(f"{row.name}: {bits} names no system: 1 GPS + 2 SBAS + 4 GLONASS + 8 Galileo + 16 QZSS + 32 BeiDou + 64 NavIC")
    return taken(f"{bits} is {letters}", systems=letters)


def _excluded(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    names: list[str] = []
    forced: list[str] = []
    for word in text.replace(",", " ").split():
        match = _SATELLITE.fullmatch(word)
        if match is None:
            raise ConfError(f"{row.name}: {clip(word)!r} is no satellite such as G05")
        number = int(match[3]) - (_SBAS_FIRST if match[2] == "S" and int(match[3]) > _SBAS_FIRST else 0)
        if number > 99:
            raise ConfError(f"{row.name}: {clip(word)!r} is no satellite such as G05")
        (forced if match[1] else names).append(f"{match[2]}{number:02d}")
    if forced:
        return Change(
            row.fate, f"unhealthy satellites are never used: {' '.join(forced)} is not forced", {"excluded": tuple(names)}, alters=True
        )
    return taken("", excluded=tuple(names))


def _mask_switch(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    if value_of(row, text, dialect) == "on":
        return translated(row.why)
    return translated("off: no mask", cn0_mask_dbhz=0.0)


def _mask(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    least = min(mask_values(row, text))
    return translated(f"{row.why} ({least:g} dBHz)", cn0_mask_dbhz=least)


def mask_values(row: Row, text: str) -> list[float]:
    """Return the nine values of an SNR mask (RTKLIB takes missing ones for 0); ConfError for what is no number."""
    try:
        values = [float(part or "0") for part in text.strip().split(",")]
    except ValueError:
        raise ConfError(f"{row.name}: {clip(text.strip())!r} is not nine numbers with commas between") from None
    if len(values) > 9 or not all(0.0 <= value <= 60.0 for value in values):
        raise ConfError(f"{row.name}: {clip(text.strip())!r} is not nine numbers from 0 to 60 dBHz with commas between")
    return [*values, *[0.0] * (9 - len(values))]


def _tides(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    bits = int(number_of(row, text, dialect))
    note = "solid tides are always applied"
    if text.strip() == "on" and dialect == "demo5":
        note += "; demo5 reads 'on' as 0, that is off"
    return ignored(note if bits <= _SOLID_TIDES else f"{note}, ocean loading and pole tides never", alters=bits > _SOLID_TIDES)


def _soltype(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    value = str(value_of(row, text, dialect))
    return translated(
        f"{row.why}: --direction {value.removesuffix('-nophasereset')}" if value != "forward" else "a live solver goes forward"
    )


def _dynamics(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    return translated(
        "velocity and acceleration are always estimated" + ("" if value_of(row, text, dialect) == "on" else ", with our own noise")
    )


def _sync(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    return taken(row.why, sync__matched_only=value_of(row, text, dialect) == "on")


def _interpolation(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    """RTKLIB's off is its default, and no wish of the file's author: rtkmesh solve has its own."""
    return taken(row.why, sync__interpolate=True if value_of(row, text, dialect) == "on" else None)


def _length(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    value = number_of(row, text, dialect)
    return taken("" if value else "unknown length", baseline_length_m=value or None)


def _length_sigma(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    value = number_of(row, text, dialect)
    return taken("", baseline_sigma_m=value) if value else taken("ours, 0.01 m", baseline_sigma_m=0.01)


def _least(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    count = max(LEAST_AMBIGUITIES, int(number_of(row, text, dialect)) - 1)
    return translated(f"satellites less one, at least {LEAST_AMBIGUITIES}", ambiguity__minimum_ambiguities=count)


def _hold(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    return taken("", ambiguity__hold_after_epochs=max(1, int(number_of(row, text, dialect))))


def _other_ratio(table: SolverTable, row: Row, text: str, dialect: Dialect) -> Change:
    ratio, first = number_of(row, text, dialect), table.noise.code_ratio
    return ignored(row.why, alters=first is not None and ratio not in (0.0, first))


_WHOLE: Final = {"ambiguity.minimum_lock_epochs"}
_SETTERS: Final[dict[str, Setter]] = {
    "pos1-posmode": _mode,
    "pos1-frequency": _frequencies,
    "pos1-navsys": _systems,
    "pos1-exclsats": _excluded,
    "pos1-snrmask_r": _mask_switch,
    "pos1-snrmask_b": _mask_switch,
    **{f"pos1-snrmask_L{band}": _mask for band in "1256"},
    "pos1-tidecorr": _tides,
    "pos1-soltype": _soltype,
    "pos1-dynamics": _dynamics,
    "pos2-syncsol": _sync,
    "misc-timeinterp": _interpolation,
    "pos2-baselen": _length,
    "pos2-basesig": _length_sigma,
    "pos2-minfixsats": _least,
    "pos2-arminfix": _hold,
    **{f"stats-eratio{band}": _other_ratio for band in "256"},
    **dict.fromkeys(
        (
            "pos1-elmask", "pos2-armode", "pos2-arthres", "pos2-arlockcnt", "pos2-arelmask", "pos2-maxage", "stats-eratio1",
            "stats-errphase", "stats-errphaseel", "stats-prnaccelh", "stats-prnaccelv", "stats-prnbias",
        ),
        _plain,
    ),
}  # fmt: skip


def with_values(table: SolverTable, key: str, values: dict[str, Any]) -> SolverTable:
    """Return a table with other values of dotted keys; ConfError for one out of its bounds."""
    content: dict[str, Any] = msgspec.to_builtins(table)
    for path, value in values.items():
        *tables, name = path.split(".")
        inner = content
        for part in tables:
            inner = inner.setdefault(part, {})
        inner[name] = value
    try:
        return msgspec.convert(content, SolverTable)
    except msgspec.ValidationError as error:
        raise ConfError(f"{key}: {str(error).partition(' - at')[0].replace('`', '')}") from None


# Values that are None in a table -> what the engine uses then: RTKLIB wants to be told.
ENGINE_DEFAULTS: Final[dict[str, Any]] = {
    "noise.phase_a_m": 0.003,
    "noise.phase_b_m": 0.003,
    "noise.code_ratio": 150.0,
    "dynamics.acceleration_horizontal_mps2": 3.0,
    "dynamics.acceleration_vertical_mps2": 1.5,
    "dynamics.ambiguity_cyc": 4e-3,
    "ambiguity.mode": "continuous",
    "ambiguity.ratio": 3.0,
    "ambiguity.elevation_mask_deg": 15.0,
    "ambiguity.minimum_lock_epochs": 0,
    "ambiguity.minimum_ambiguities": LEAST_AMBIGUITIES,
    "ambiguity.hold_after_epochs": 20,
    "ambiguity.failure_rate": 1.0,
    "integrity.enabled": True,
    "integrity.risk": 1e-5,
    "integrity.alert_horizontal_m": 1.0,
    "integrity.alert_vertical_m": 2.0,
}


def effective(table: SolverTable, path: str) -> Any:
    """Return the value that the engine uses for a dotted key."""
    value = present(table, path)
    return ENGINE_DEFAULTS.get(path) if value is None else value
