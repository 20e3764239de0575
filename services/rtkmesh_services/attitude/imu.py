"""Samples of an IMU as any program publishes them: turn rates, specific force, growth of its own yaw."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.errors import DecodeError
from rtkmesh_services.runtime.rule_words import message_of

Vector = tuple[float, float, float]

_LARGEST = 1e100  # NaN is not below it, either
_LONGEST_S = 10.0  # of a growth of yaw


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One sample; axes forward, right, down. ``force_mps2``: (0, 0, -9.81) at rest and level. ``yaw``: growth (rad), and its time (s)."""

    time: GpsTime
    rate_radps: Vector | None = None
    force_mps2: Vector | None = None
    yaw: tuple[float, float] | None = None


def imu_of(payload: bytes, encoding: str) -> ImuSample:
    """Return the sample of a message; DecodeError for what is none."""
    try:
        return imu_sample(message_of(payload, encoding))
    except ValueError as error:
        raise DecodeError(str(error)) from error


def imu_sample(message: Any) -> ImuSample:
    """Return the sample of a map from any program; DecodeError for what is none."""
    if not isinstance(message, dict):
        raise DecodeError("no map with rate_radps, force_mps2 or yaw_increment_rad")
    fields: dict[str, Any] = {str(key): value for key, value in message.items()}  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]  any program's
    sample = ImuSample(_time_of(fields), _vector(fields, "rate_radps"), _vector(fields, "force_mps2"), _yaw(fields))
    if sample.rate_radps is None and sample.force_mps2 is None and sample.yaw is None:
        raise DecodeError("neither rate_radps nor force_mps2 nor yaw_increment_rad")
    return sample


def _vector(fields: dict[str, Any], name: str) -> Vector | None:
    value = fields.get(name)
    if value is None:
        return None
    if not isinstance(value, list | tuple) or len(value) != 3 or not all(_is_number(part) for part in value):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  any program's
        raise DecodeError(f"{name} is no list of three numbers")
    x, y, z = (float(part) for part in value)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  numbers
    return x, y, z


def _yaw(fields: dict[str, Any]) -> tuple[float, float] | None:
    grown, interval_s = fields.get("yaw_increment_rad"), fields.get("interval_s")
    if grown is None:
        return None
    if not (_is_number(grown) and _is_number(interval_s) and 0.0 < float(interval_s or 0.0) <= _LONGEST_S):
        raise DecodeError("yaw_increment_rad and interval_s are no numbers, or interval_s is not above 0 and at most 10")
    return float(grown), float(interval_s or 0.0)


def _time_of(fields: dict[str, Any]) -> GpsTime:
    week, tow_s, utc_s = fields.get("week"), fields.get("tow_s"), fields.get("utc_s")
    if isinstance(week, int) and 0 <= week < 10000 and _is_number(tow_s) and 0.0 <= float(tow_s or 0.0) < 604800.0:
        return GpsTime(week, float(tow_s or 0.0))
    if _is_number(utc_s) and 315964800.0 <= float(utc_s or 0.0) < 4e9:
        return GpsTime.from_utc(datetime.fromtimestamp(0, UTC) + timedelta(seconds=float(utc_s or 0.0)))
    raise DecodeError("neither week and tow_s nor utc_s")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _LARGEST
