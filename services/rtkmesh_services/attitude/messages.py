"""Attitudes of bodies as messages."""

from math import degrees, isfinite, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.baseline import yaw_enu
from rtkmesh.attitude.integrity import Finding
from rtkmesh.attitude.joint import angles_covariance, length_m, point_of, rotation_covariance
from rtkmesh.attitude.rigid_body import Fit, Layout, Shape
from rtkmesh.attitude.rotation import NED_FROM_ENU, quaternion_of
from rtkmesh.codecs.nmea_encode import hdt, ths
from rtkmesh.gnss.integrity import Integrity
from rtkmesh_schemas.attitude import AttitudeMessage, BodyPoint
from rtkmesh_services.attitude.body import BodyAttitude
from rtkmesh_services.attitude.points import placed
from rtkmesh_services.attitude.readings import Reading, SourceKind

Matrix = NDArray[np.float64]
Points = dict[str, tuple[float, float, float]]

FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
_WORDS = {
    Finding.NO_ATTITUDE: "no attitude",
    Finding.NO_REDUNDANCY: "nothing tests it",
    Finding.NOT_IDENTIFIABLE: "one of {suspects} is at fault, which is not to be told",
}


def rotation_fields(ned_from_body: Matrix, cov_ned_rad2: Matrix) -> dict[str, Any]:
    """Return the quaternions of a rotation and its covariance as fields of a message."""
    enu_from_flu = NED_FROM_ENU @ ned_from_body @ FLU_FROM_FRD
    return {
        "quaternion_ned_from_body": tuple(quaternion_of(ned_from_body).tolist()),
        "quaternion_enu_from_flu": tuple(quaternion_of(enu_from_flu).tolist()),
        "rotation_cov_ned_rad2": tuple(cov_ned_rad2.ravel().tolist()),
    }


def angles_fields(angles_rad: tuple[float, float, float], cov_rad2: Matrix) -> dict[str, Any]:
    """Return heading, pitch, roll (rad), what is not seen as NaN, and their covariance (3x3) as fields of a message."""
    heading, pitch, roll = (
        angle if np.isfinite(variance) else nan for angle, variance in zip(angles_rad, np.diag(cov_rad2).tolist(), strict=True)
    )
    yaw = yaw_enu(heading) if np.isfinite(heading) else nan
    values = {"heading_rad": heading, "pitch_rad": pitch, "roll_rad": roll, "yaw_enu_rad": yaw}
    return {**values, "covariance_rad2": tuple(cov_rad2.ravel().tolist())}


def body_message(found: BodyAttitude, layout: Layout, points: Points, unseen_sigma_rad: float, **identity: Any) -> AttitudeMessage:
    """Return the message of a body's attitude; without one all is NaN, with the reason."""
    verdict, fit = found.judged, found.judged.fit
    worst = max(found.readings, key=lambda reading: reading.status, default=None)
    integrity = Integrity.OK if verdict.finding is Finding.NO_REDUNDANCY else verdict.integrity
    return AttitudeMessage(
        week=found.time.week,
        tow_s=found.time.tow_s,
        status=0 if worst is None or fit is None else worst.status,
        status_name="NONE" if worst is None or fit is None else worst.status_name,
        integrity=integrity.value,
        reason=reason_of(found),
        **_fit_fields(fit, unseen_sigma_rad),
        **_length_fields(found, layout),
        antennas=[name for name in layout.names if ": " not in name],
        age_s=max((reading.age_s for reading in found.readings), default=0.0),
        received_mono_ns=max((reading.received_mono_ns for reading in found.readings), default=0),
        finding=verdict.finding.value,
        antennas_used=list(found.used),
        antennas_excluded=list(verdict.excluded),
        antennas_suspect=list(verdict.suspects),
        sources={reading.source.id: reading.kind.value for reading in found.readings},
        sources_missing=found.missing,
        geometry="" if found.chosen is None else found.chosen.verdict,
        geometry_wrong_probability=nan if found.chosen is None else found.chosen.wrong_probability,
        points={name: _point(found, fit, np.array(place), unseen_sigma_rad) for name, place in points.items()},
        **identity,
    )


def reason_of(found: BodyAttitude) -> str:
    """Return what there is to say of an attitude: its fault, and what it had to do without."""
    verdict = found.judged
    said = [_WORDS[verdict.finding].format(suspects=", ".join(verdict.suspects))] if verdict.finding in _WORDS else []
    said += [f"without {name}, which is at fault" for name in verdict.excluded]
    said += [] if found.chosen is None else found.chosen.notes
    return "; ".join([*said, *found.missing.values()])


def nmea_of(message: AttitudeMessage) -> str:
    """Return the heading as NMEA sentences: HDT, only of an attitude that passed its tests, and THS, which says V without one."""
    heading_deg = degrees(message.heading_rad) if message.integrity == Integrity.OK.value else nan
    return (hdt(heading_deg) if isfinite(heading_deg) else "") + ths(heading_deg)


def _fit_fields(fit: Fit | None, unseen_sigma_rad: float) -> dict[str, Any]:
    if fit is None:
        return {**angles_fields((nan, nan, nan), np.full((3, 3), nan)), "shape": Shape.POINT.value}
    return {
        **angles_fields(fit.angles_rad, angles_covariance(fit, unseen_sigma_rad)),
        **rotation_fields(fit.ned_from_body, rotation_covariance(fit, unseen_sigma_rad)),
        "chi_square": fit.chi_square,
        "degrees": fit.degrees,
        "shape": fit.shape.value,
    }


def _length_fields(found: BodyAttitude, layout: Layout) -> dict[str, float]:
    """Return the length of the baseline when it is the only one."""
    lines = [reading for reading in found.readings if reading.source.kind is SourceKind.BASELINE]
    if len(lines) != 1:
        return {"baseline_length_m": nan, "length_error_m": nan}
    return _length(lines[0], layout)


def _length(reading: Reading, layout: Layout) -> dict[str, float]:
    assert reading.edge is not None, "it was used"
    measured = float(np.linalg.norm(reading.edge.vector_ned_m))
    known = length_m(layout, reading.source.start, reading.source.end)
    return {"baseline_length_m": measured, "length_error_m": measured - known}


def _point(found: BodyAttitude, fit: Fit | None, body_m: Matrix, unseen_sigma_rad: float) -> BodyPoint:
    if fit is None or found.origin_ecef_m is None or found.ned_from_ecef is None:
        return BodyPoint()
    place, cov = point_of(fit, body_m, unseen_sigma_rad)
    if not np.isfinite(place).all():
        return BodyPoint()
    return placed(BodyPoint(), found.origin_ecef_m + found.ned_from_ecef.T @ place, cov)
