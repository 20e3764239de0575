"""What an attitude process takes: solutions of solvers and headings of receivers, each as edges of the body's antennas at an instant."""

from dataclasses import dataclass, field
from enum import StrEnum
from math import asin, atan2, hypot, isfinite, nan, radians, sqrt
from typing import Any

import numpy as np

from rtkmesh.attitude.joint import Edge, heading_edge
from rtkmesh.attitude.rotation import NED_FROM_ENU, rotation_of_angles
from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.attitude import HeadingMessage
from rtkmesh_schemas.config_attitude import ReceiverHeadingTable
from rtkmesh_schemas.errors import DecodeError
from rtkmesh_schemas.solution import SolutionMessage

FIX, FLOAT = 1, 2
LARGEST_M, LARGEST_M2 = 1e8, 1e6  # beyond the earth, and a kilometre: no measurements (nor is NaN)
LARGEST_CLOCK_S = 0.1  # receivers keep theirs within a millisecond or two; beyond this (nor is NaN) it is none
VIRTUAL_LENGTH_M = 1.0  # of the line of antennas of a heading that says no length
_LOOSE_RAD = 1.0


class SourceKind(StrEnum):
    """What a source measures."""

    BASELINE = "baseline"
    POSITION = "position"
    HEADING = "heading"
    GEOMETRY = "geometry"  # a baseline whose integers were chosen together with those of others


@dataclass(frozen=True, slots=True)
class SourceSpec:
    """A source: the id of its process, what it measures and the two ends, from and to (a position's is a fixed base)."""

    id: str
    kind: SourceKind
    start: str
    end: str
    heading: ReceiverHeadingTable | None = None


def right_of(name: str) -> str:
    """Return the end of the line to the right of a receiver that tells a whole attitude."""
    return f"{name}: right"


@dataclass(frozen=True, slots=True)
class Reading:
    """One message of a source. ``edge`` None: it says nothing now, and ``reason`` why. Of a position the vector is ECEF.

    ``across``: the other edge of a receiver that tells a whole attitude. ``velocity_enu_mps`` of a position with its covariance.
    ``candidates_follow``: those of its integers; ``chosen``: its integers are of the geometry, not of its solver; ``solution``: what it
    was read from.

    ``time`` is the tag, ``clock_s`` by how much the receiver's clock was ahead when it measured: the instant is ``time`` minus that.
    """

    source: SourceSpec
    time: GpsTime
    edge: Edge | None
    reason: str = ""
    status: int = 0
    status_name: str = "NONE"
    age_s: float = 0.0
    received_mono_ns: int = 0
    velocity_ecef_mps: tuple[float, float, float] = field(default=(nan, nan, nan))
    across: Edge | None = None
    velocity_enu_mps: tuple[float, float, float] = field(default=(nan, nan, nan))
    velocity_cov_enu_m2ps2: tuple[float, ...] = (nan,) * 9
    clock_s: float = 0.0
    candidates_follow: bool = False
    chosen: bool = False
    solution: SolutionMessage | None = None

    @property
    def kind(self) -> SourceKind:
        """What it is as part of an attitude."""
        return SourceKind.GEOMETRY if self.chosen else self.source.kind


def of_solution(source: SourceSpec, message: SolutionMessage, *, accept_float: bool) -> Reading:
    """Return the reading of a solver's solution; DecodeError for times that are none."""
    usable = message.status == FIX or (accept_float and message.status == FLOAT)
    edge = (_baseline(source, message) if source.kind is SourceKind.BASELINE else _position(source, message)) if usable else None
    reason = "" if edge is not None else f"{source.id} is {message.status_name}: {message.reason}"
    if edge is not None and message.integrity == Integrity.FAILED.value:
        edge, reason = None, f"{source.id} fails its integrity test: {message.integrity_reason}"
    return Reading(
        source=source,
        time=time_of(message.week, message.tow_s),
        edge=edge,
        reason=reason,
        status=message.status,
        status_name=message.status_name,
        age_s=message.age_s,
        received_mono_ns=message.received_mono_ns,
        velocity_ecef_mps=message.velocity_ecef_mps,
        velocity_enu_mps=message.velocity_enu_mps,
        velocity_cov_enu_m2ps2=message.velocity_cov_enu_m2ps2,
        solution=message,
        candidates_follow=message.candidates and source.kind is SourceKind.BASELINE,
        clock_s=message.receiver_clock_s if abs(message.receiver_clock_s) < LARGEST_CLOCK_S else 0.0,
    )


def of_heading(source: SourceSpec, message: HeadingMessage, length_m: float, unseen_sigma_rad: float) -> Reading | None:
    """Return the reading of a receiver's heading; None for one without a time: nothing can be matched with it.

    ``length_m``: known distance of its antennas; ``unseen_sigma_rad``: of the pitch of a heading that says none.
    """
    if message.time is None:
        return None
    assert source.heading is not None, "headings have a table"
    edge = _line(source, source.heading, message, length_m, unseen_sigma_rad) if message.valid and isfinite(message.heading_rad) else None
    return Reading(
        source=source,
        time=time_of(*message.time),
        edge=edge,
        across=None if edge is None else _across(source, source.heading, message),
        reason="" if edge is not None else f"{source.id} has no heading ({message.message} {message.solution})".replace(" )", ")"),
        status=FLOAT if message.solution == "float" else FIX,
        status_name="FLOAT" if message.solution == "float" else "FIX",
        received_mono_ns=message.received_mono_ns,
    )


def time_of(week: int, tow_s: float) -> GpsTime:
    """Return a time; DecodeError for what is none."""
    if not (0 <= week < 10000 and 0.0 <= tow_s < 604800.0):
        raise DecodeError(f"{week} {tow_s} is no GPS time")
    return GpsTime(week, tow_s)


def _baseline(source: SourceSpec, message: SolutionMessage) -> Edge | None:
    return _edge(source, NED_FROM_ENU @ np.array(message.baseline_enu_m), message.baseline_cov_enu_m2, wrong_probability(message))


def _position(source: SourceSpec, message: SolutionMessage) -> Edge | None:
    return _edge(source, np.array(message.position_ecef_m), message.position_cov_enu_m2, wrong_probability(message))


def wrong_probability(message: SolutionMessage) -> float:
    """Return the probability that a fix is wrong; 0 where the solver says nothing of it, and of a float."""
    return 1.0 - message.fix_probability if 0.0 < message.fix_probability <= 1.0 else 0.0


def _edge(source: SourceSpec, vector: Any, cov_enu_m2: tuple[float, ...], wrong: float) -> Edge | None:
    """Return the edge, None unless its covariance is one."""
    if len(cov_enu_m2) != 9 or not np.abs(vector).max() < LARGEST_M or not np.abs(cov_enu_m2).max() < LARGEST_M2:
        return None
    cov = NED_FROM_ENU @ np.array(cov_enu_m2).reshape(3, 3) @ NED_FROM_ENU
    return Edge(source.start, source.end, vector, cov, wrong=wrong) if float(np.linalg.eigvalsh(cov)[0]) > 0.0 else None


def _line(source: SourceSpec, table: ReceiverHeadingTable, message: HeadingMessage, length_m: float, unseen_sigma_rad: float) -> Edge:
    """Return the edge of a heading. A length that the receiver measured is one more thing that must agree."""
    pitch_known = isfinite(message.pitch_rad)
    pitch = message.pitch_rad if pitch_known else 0.0
    sigma = _at_least(message.heading_sigma_rad, radians(table.sigma_deg))
    pitch_sigma = _at_least(message.pitch_sigma_rad, sqrt(2.0) * sigma) if pitch_known else hypot(unseen_sigma_rad, sigma)
    measured = isfinite(message.length_m) and message.length_m > 0.0 and bool(table.antennas)
    length_sigma = _at_least(message.length_sigma_m, length_m * sigma) if measured else None
    edge = heading_edge((source.start, source.end), (message.heading_rad, pitch), (sigma, pitch_sigma), length_m, length_sigma)
    if not measured:
        return edge
    return Edge(edge.start, edge.end, edge.vector_ned_m * (message.length_m / length_m), edge.cov_m2, alone=True)


def _across(source: SourceSpec, table: ReceiverHeadingTable, message: HeadingMessage) -> Edge | None:
    """Return the edge to the right of a vehicle's attitude: of its azimuth, which the line of the heading has, next to nothing is said."""
    if table.antennas or message.of_baseline or not isfinite(message.pitch_rad + message.roll_rad):
        return None
    north, east, down = rotation_of_angles(message.heading_rad, message.pitch_rad, message.roll_rad)[:, 1].tolist()
    sigma = _at_least(message.roll_sigma_rad, sqrt(2.0) * radians(table.sigma_deg))
    angles, sigmas = (atan2(east, north), -asin(max(-1.0, min(1.0, down)))), (_LOOSE_RAD, sigma)
    return heading_edge((source.start, right_of(source.id)), angles, sigmas, VIRTUAL_LENGTH_M, None)


def _at_least(sigma: float, least: float) -> float:
    return max(sigma, least) if isfinite(sigma) else least
