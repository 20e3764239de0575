"""The attitude of one baseline: heading and one tilt angle, by its mounting, with full covariance and the test of its length."""

from math import cos, isfinite, nan, radians, sin
from typing import Any

import msgspec
import numpy as np

from rtkmesh.attitude.baseline import BaselineAttitude, Integrity, Mounting, baseline_attitude, length_error_m, length_integrity
from rtkmesh.attitude.integrity import Finding
from rtkmesh.attitude.rigid_body import Shape
from rtkmesh.attitude.rotation import NED_FROM_ENU, angles_per_error, rotation_of_angles
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.config_attitude import AntennaPlaceTable, AttitudeTable
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_services.attitude.body import Body
from rtkmesh_services.attitude.geometry import Chosen
from rtkmesh_services.attitude.messages import angles_fields, rotation_fields
from rtkmesh_services.attitude.readings import FIX, FLOAT, Reading, SourceKind, SourceSpec


def mounting_of(table: AttitudeTable) -> Mounting:
    """Return the engine's mounting of an attitude table."""
    return Mounting(radians(table.mounting_deg), radians(table.mounting_pitch_deg), table.length_m, table.length_tolerance_m)


def body_of_length(table: AttitudeTable, spec: SourceSpec) -> Body | None:
    """Return the two antennas of a table's one baseline as a body that chooses integers; None where their distance is not known."""
    if table.length_m is None or not table.geometry:
        return None
    azimuth, elevation = radians(table.mounting_deg), radians(table.mounting_pitch_deg)
    level_m = table.length_m * cos(elevation)
    place = (level_m * cos(azimuth), level_m * sin(azimuth), -table.length_m * sin(elevation))
    start, end = AntennaPlaceTable(position_m=(0.0, 0.0, 0.0)), AntennaPlaceTable(position_m=place, sigma_m=table.length_sigma_m)
    return Body(msgspec.structs.replace(table, antennas={spec.start: start, spec.end: end}), (spec,))


def chosen_solution(reading: Reading, chosen: Chosen | None) -> SolutionMessage:
    """Return the solution that a reading is of, with the baseline that the known length chose."""
    assert reading.solution is not None, "it is of a solver"
    if not reading.chosen or reading.edge is None or chosen is None:
        return reading.solution
    return msgspec.structs.replace(
        reading.solution, status=reading.status, status_name=reading.status_name, reason="", integrity="", integrity_reason="",
        baseline_enu_m=tuple((NED_FROM_ENU @ reading.edge.vector_ned_m).tolist()),
        baseline_cov_enu_m2=tuple((NED_FROM_ENU @ reading.edge.cov_m2 @ NED_FROM_ENU).ravel().tolist()),
        fix_probability=1.0 - chosen.wrong_probability, protection_horizontal_m=nan, protection_vertical_m=nan,
    )  # fmt: skip


def chosen_message(
    reading: Reading, solution: SolutionMessage, chosen: Chosen | None, table: AttitudeTable, mounting: Mounting, identity: dict[str, Any]
) -> AttitudeMessage:
    """Return the attitude of a ``chosen_solution``."""
    message = attitude_message(solution, table, mounting, [reading.source.start, reading.source.end], identity)
    told = {} if chosen is None else {"geometry": chosen.verdict, "geometry_wrong_probability": chosen.wrong_probability}
    return msgspec.structs.replace(message, sources=dict.fromkeys(message.sources, reading.kind.value), **told)


def attitude_message(
    solution: SolutionMessage, table: AttitudeTable, mounting: Mounting, antennas: list[str], identity: dict[str, Any]
) -> AttitudeMessage:
    """Return the attitude of one solution; unavailable ones carry NaN and the reason, never a heading of zero."""
    usable = solution.status == FIX or (table.accept_float and solution.status == FLOAT)
    attitude = _attitude_of(solution, mounting) if usable else None
    integrity, reason = _judge(solution, attitude, mounting)
    return AttitudeMessage(
        week=solution.week,
        tow_s=solution.tow_s,
        status=solution.status,
        status_name=solution.status_name,
        integrity=integrity.value,
        reason=reason,
        **_angles(attitude, radians(table.unseen_tilt_deg)),
        finding=_finding(attitude, mounting, integrity).value,
        antennas_used=[] if attitude is None else antennas,
        shape=(Shape.POINT if attitude is None else Shape.LINE).value,
        sources={} if attitude is None else {table.solver: SourceKind.BASELINE.value},
        sources_missing={table.solver: reason} if attitude is None else {},
        baseline_length_m=nan if attitude is None else attitude.length_m,
        length_error_m=nan if attitude is None else length_error_m(attitude, mounting),
        antennas=antennas,
        age_s=solution.age_s,
        received_mono_ns=solution.received_mono_ns,
        **identity,
    )


def _attitude_of(solution: SolutionMessage, mounting: Mounting) -> BaselineAttitude | None:
    baseline = np.array(solution.baseline_enu_m)
    if not np.isfinite(baseline).all():
        return None
    attitude = baseline_attitude(baseline, np.array(solution.baseline_cov_enu_m2).reshape(3, 3), mounting)
    return attitude if isfinite(attitude.heading_rad) else None


def _judge(solution: SolutionMessage, attitude: BaselineAttitude | None, mounting: Mounting) -> tuple[Integrity, str]:
    if attitude is None:
        return Integrity.UNAVAILABLE, f"baseline is {solution.status_name}: {solution.reason}"
    if solution.integrity == Integrity.FAILED.value:
        return Integrity.FAILED, f"baseline fails its integrity test: {solution.integrity_reason}"
    if length_integrity(attitude, mounting) is Integrity.FAILED:
        return Integrity.FAILED, f"baseline is {attitude.length_m:.3f} m, known length is {mounting.length_m:.3f} m"
    return Integrity.OK, ""


def _angles(attitude: BaselineAttitude | None, unseen_sigma_rad: float) -> dict[str, Any]:
    """Return angles, rotation and covariances; in the rotation the unseen angle is level, good to ``unseen_sigma_rad``."""
    if attitude is None:
        return angles_fields((nan, nan, nan), np.full((3, 3), nan))
    angles = (attitude.heading_rad, attitude.pitch_rad, attitude.roll_rad)
    unseen = ~np.isfinite(np.diag(attitude.cov_rad2))
    full = np.where(np.isfinite(attitude.cov_rad2), attitude.cov_rad2, 0.0) + np.diag(np.where(unseen, unseen_sigma_rad**2, 0.0))
    rotation = rotation_of_angles(*(angle if isfinite(angle) else 0.0 for angle in angles))
    error_of = np.linalg.inv(angles_per_error(rotation))
    return angles_fields(angles, attitude.cov_rad2) | rotation_fields(rotation, error_of @ full @ error_of.T)


def _finding(attitude: BaselineAttitude | None, mounting: Mounting, integrity: Integrity) -> Finding:
    if attitude is None:
        return Finding.NO_ATTITUDE
    if mounting.length_m is None:
        return Finding.NO_REDUNDANCY
    return Finding.OK if integrity is Integrity.OK else Finding.NOT_IDENTIFIABLE
