"""RTKLIB demo5 in this process (pyrtklib5), as an oracle for streams of receivers."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rtkmesh.gnss.epoch import SLIP, Epoch, make_epoch
from rtkmesh.gnss.signals import satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime

_FIRST = {"G": 1, "R": 33, "E": 60, "J": 96, "C": 106}  # satellite numbers of its build
_KNOWN = 168  # the last one, C63; behind them stand NavIC and SBAS
_SLOTS = 3  # signals of a satellite
_EPHEMERIS = (
    "M0", "deln", "OMG0", "omg", "OMGd", "i0", "idot", "e", "A", "cuc", "cus", "crc", "crs", "cic", "cis", "f0", "f1", "f2", "iode", "iodc",
    "svh", "toes",
)  # fmt: skip


@pytest.fixture(scope="session")
def demo5() -> Callable[..., tuple[list[Epoch], dict[int, Any]]]:
    """A function of format (sbf, ubx, oem4, rtcm3), bytes and options (and for RTCM 3 a time near): epochs and Keplerian ephemerides.

    These are by satellite, with RTKLIB's names. What still waits for more bytes stays in it. Of each satellite it holds one signal in each
    of three frequencies.
    """
    library: Any = pytest.importorskip("pyrtklib5", reason="pyrtklib5 has wheels for x86-64 only")

    def read(form: str, data: bytes, options: str = "", near: GpsTime | None = None) -> tuple[list[Epoch], dict[int, Any]]:
        raw = library.rtcm_t() if form == "rtcm3" else library.raw_t()
        if form == "rtcm3":
            assert library.init_rtcm(raw)
            raw.time = library.gpst2time(near.week, near.tow_s) if near else raw.time
        else:
            assert library.init_raw(raw, {"sbf": library.STRFMT_SEPT, "ubx": library.STRFMT_UBX, "oem4": library.STRFMT_OEM4}[form])
        for k, character in enumerate(options + "\0"):
            raw.opt[k] = character
        take = getattr(library, f"input_{form}")
        epochs: list[Epoch] = []
        ephemerides: dict[int, Any] = {}
        for byte in data:
            found = take(raw, byte)
            if found == 1 and raw.obs.n:
                epochs.append(_epoch(library, raw.obs))
            elif found == 2 and not _name(raw.ephsat).startswith("R"):
                kept = raw.nav.eph[raw.ephsat - 1]
                ephemerides[satellite_number(_name(raw.ephsat))] = _Kept({name: getattr(kept, name) for name in _EPHEMERIS})
        return epochs, ephemerides

    return read


class _Kept:
    """The fields of an ephemeris as they were."""

    def __init__(self, values: dict[str, float]) -> None:
        self.__dict__.update(values)


def _name(number: int) -> str:
    """Return the RINEX id of a satellite of RTKLIB's."""
    system = max((letter for letter, start in _FIRST.items() if start <= number), key=_FIRST.__getitem__)
    return f"{system}{number - _FIRST[system] + 1:02d}"


def _epoch(library: Any, obs: Any) -> Epoch:
    found: list[tuple[Any, ...]] = []
    for i in range(obs.n):
        o = obs.data[i]
        if o.sat > _KNOWN:
            continue
        signals = [(k, library.code2obs(o.code[k])) for k in range(_SLOTS) if o.code[k] and o.P[k]]
        found += [
            (satellite_number(_name(o.sat)), signal_number(code), o.P[k], o.L[k] or np.nan, o.D[k], o.SNR[k], SLIP if o.LLI[k] & 1 else 0)
            for k, code in signals
        ]
    names = ("satellite", "signal", "pseudorange_m", "phase_cyc", "doppler_hz", "cn0_dbhz", "flags")
    week = library.Arr1Dint(1)
    tow_s = library.time2gpst(obs.data[0].time, week)
    return make_epoch(GpsTime(week[0], round(tow_s, 7)), **dict(zip(names, zip(*found, strict=True), strict=True)))
