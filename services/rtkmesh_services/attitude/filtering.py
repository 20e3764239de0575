"""The filtered attitude: what each epoch gives and a gyro in between, as one attitude that goes on while epochs are missing."""

from collections import Counter
from datetime import UTC, datetime, timedelta
from typing import Any

import msgspec
import numpy as np

from rtkmesh.attitude.filter_options import Estimate, FilterOptions, Kind, Trust, Update
from rtkmesh.attitude.heading_filter import filter_of
from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.attitude import NAN3, NAN4, NAN9, AttitudeMessage
from rtkmesh_schemas.config_attitude import AttitudeFilterTable, AttitudeTable
from rtkmesh_schemas.errors import DecodeError
from rtkmesh_services.attitude.body import BodyAttitude
from rtkmesh_services.attitude.messages import angles_fields, rotation_fields
from rtkmesh_services.attitude.readings import FIX
from rtkmesh_services.runtime.rule_words import message_of

_LARGEST = 1e100  # NaN is not below it, either
_SEEN_SHARE = 0.5  # of the sigma of a tilt that nothing measures


class Filtering:
    """The filter of one attitude process and its figures."""

    def __init__(self, table: AttitudeTable, options: AttitudeFilterTable, unseen_sigma_rad: float) -> None:
        self._filter = filter_of(options_of(options, table, unseen_sigma_rad))
        self._sigma_radps = 0.0 if table.imu is None else table.imu.sigma_radps
        self._unseen_rad = unseen_sigma_rad
        self.counts: Counter[str] = Counter()

    @property
    def resets(self) -> int:
        """How often the filter began anew."""
        return self._filter.resets

    def epoch(self, found: BodyAttitude) -> Update | None:
        """Take the attitude of an epoch; None when it has none."""
        fit = found.judged.fit
        if fit is None:
            return None
        fixed = all(reading.status == FIX for reading in found.readings)
        integrity = Integrity.FAILED if found.judged.integrity is Integrity.FAILED else Integrity.OK
        return self._counted("epochs", self._filter.rotation(found.time, fit, Trust(fixed=fixed, integrity=integrity)))

    def gyro(self, payload: bytes, encoding: str) -> GpsTime:
        """Take a sample of a gyro and return its time; DecodeError for what is none."""
        try:
            time, rate_radps = gyro_sample(message_of(payload, encoding))
        except ValueError as error:
            raise DecodeError(str(error)) from error
        self._counted("gyro", self._filter.gyro(time, np.array(rate_radps), self._sigma_radps))
        return time

    def message(self, time: GpsTime, epoch: AttitudeMessage, **identity: Any) -> AttitudeMessage:
        """Return the filtered attitude at a time, with what is to be said of the newest epoch before it."""
        estimate = self._filter.predicted(time)
        fields = _known(estimate, self._unseen_rad) if estimate.ned_from_body is not None else _unknown(estimate)
        told: dict[str, Any] = {"week": time.week, "tow_s": time.tow_s, "predicted_s": estimate.age_s, "resets": self.resets, "points": {}}
        told |= {"protection_rad": NAN3, "protection_open": []}
        return msgspec.structs.replace(epoch, **(told | fields | identity))

    def _counted(self, what: str, update: Update) -> Update:
        self.counts[f"{what}_{update.outcome.value}"] += 1
        return update


def options_of(table: AttitudeFilterTable, attitude: AttitudeTable, unseen_sigma_rad: float) -> FilterOptions:
    """Return the engine's options of a table."""
    return FilterOptions(
        kind=Kind(table.kind),
        rate_walk_radps_rts=table.rate_walk_radps_rts,
        correlation_s=table.correlation_s,
        false_alarm=table.false_alarm,
        max_coast_s=table.max_coast_s,
        level_sigma_rad=unseen_sigma_rad,
        accept_float=attitude.accept_float,
    )


def gyro_sample(message: Any) -> tuple[GpsTime, tuple[float, float, float]]:
    """Return time and rate (rad/s; forward, right, down) of a map from any program; DecodeError for what is none."""
    if not isinstance(message, dict):
        raise DecodeError("no map with rate_radps")
    fields: dict[str, Any] = {str(key): value for key, value in message.items()}  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]  any program's
    rate = fields.get("rate_radps")
    if not isinstance(rate, list | tuple) or len(rate) != 3 or not all(_is_number(value) for value in rate):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  as above
        raise DecodeError("rate_radps is no list of three numbers")
    x, y, z = (float(value) for value in rate)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  numbers
    return _time_of(fields), (x, y, z)


def _time_of(fields: dict[str, Any]) -> GpsTime:
    week, tow_s, utc_s = fields.get("week"), fields.get("tow_s"), fields.get("utc_s")
    if isinstance(week, int) and 0 <= week < 10000 and _is_number(tow_s) and 0.0 <= float(tow_s or 0.0) < 604800.0:
        return GpsTime(week, float(tow_s or 0.0))
    if _is_number(utc_s) and 315964800.0 <= float(utc_s or 0.0) < 4e9:
        return GpsTime.from_utc(datetime.fromtimestamp(0, UTC) + timedelta(seconds=float(utc_s or 0.0)))
    raise DecodeError("neither week and tow_s nor utc_s")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _LARGEST


def _known(estimate: Estimate, unseen_sigma_rad: float) -> dict[str, Any]:
    assert estimate.ned_from_body is not None, "it is usable"
    cov = estimate.angles_cov_rad2
    unseen = np.sqrt(np.diag(cov)) > _SEEN_SHARE * unseen_sigma_rad
    cov[unseen, :] = cov[:, unseen] = np.nan
    return {
        **angles_fields(estimate.angles_rad, cov),
        **rotation_fields(estimate.ned_from_body, estimate.cov_rad2),
        "integrity": Integrity.OK.value,
        "rate_radps": tuple(estimate.rate_body_radps.tolist()),
        "rate_cov_rad2ps2": tuple(estimate.rate_cov_radps2.ravel().tolist()),
    }


def _unknown(estimate: Estimate) -> dict[str, Any]:
    return {
        **angles_fields(estimate.angles_rad, estimate.angles_cov_rad2),
        "quaternion_ned_from_body": NAN4,
        "quaternion_enu_from_flu": NAN4,
        "rotation_cov_ned_rad2": NAN9,
        "integrity": Integrity.UNAVAILABLE.value,
        "reason": f"filter: {estimate.why.value}",
    }
