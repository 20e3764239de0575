"""Engine epochs to and from the wire's columns."""

from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.epoch import COLUMNS, Epoch
from rtkmesh.gnss.signals import satellite_id, satellite_number, signal_code, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.errors import DecodeError
from rtkmesh_schemas.observation import Observation

_RAW: Final = tuple((name, np.dtype(dtype).newbyteorder("<")) for name, dtype, _ in COLUMNS if name not in ("satellite", "signal"))
_satellite_id, _signal_code = cache(satellite_id), cache(signal_code)
_satellite_number, _signal_number = cache(satellite_number), cache(signal_number)


def observation_of(epoch: Epoch, *, source: str, start_id: str, sequence: int, mono_ns: int = 0, utc_ns: int = 0) -> Observation:
    """Return an epoch as the wire's struct; all numbers keep every bit."""
    raw: dict[str, Any] = {name: getattr(epoch, name).astype(dtype, copy=False).tobytes() for name, dtype in _RAW}
    return Observation(
        source=source,
        start_id=start_id,
        sequence=sequence,
        week=epoch.time.week,
        tow_s=epoch.time.tow_s,
        satellite=[_satellite_id(number) for number in epoch.satellite.tolist()],
        signal=[_signal_code(number) for number in epoch.signal.tolist()],
        received_mono_ns=mono_ns,
        received_utc_ns=utc_ns,
        **raw,
    )


def epoch_of(message: Observation) -> Epoch:
    """Return the epoch of an observation, in arrays of its own; DecodeError if its columns do not fit together.

    Read-only views of the message would make numba compile every kernel a second time.
    """
    count = len(message.satellite)
    try:
        columns: dict[str, NDArray[Any]] = {
            "satellite": np.array([_satellite_number(name) for name in message.satellite], dtype=np.int16),
            "signal": np.array([_signal_number(code) for code in message.signal], dtype=np.int16),
        }
        for name, dtype in _RAW:
            columns[name] = np.frombuffer(getattr(message, name), dtype=dtype).astype(dtype.newbyteorder("="))
    except ValueError as error:
        raise DecodeError(f"observation of {message.source}: {error}") from error
    if wrong := [name for name, column in columns.items() if len(column) != count]:
        raise DecodeError(f"observation of {message.source}: {wrong[0]} has not {count} rows")
    full: dict[str, Any] = columns
    return Epoch(GpsTime(message.week, message.tow_s), **full)
