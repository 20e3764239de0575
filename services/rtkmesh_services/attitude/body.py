"""The attitude of a body of several antennas at one epoch: its readings jointly, judged."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import cos, radians, sin

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.integrity import Finding, Judged, judged
from rtkmesh.attitude.joint import Edge, joint, length_m
from rtkmesh.attitude.layout_covariance import joint_covariance
from rtkmesh.attitude.rigid_body import Layout, Measured
from rtkmesh.attitude.rotation import NED_FROM_ENU
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.config_attitude import AttitudeTable, ReceiverHeadingTable
from rtkmesh_services.attitude.geometry import Chosen, Geometry
from rtkmesh_services.attitude.matching import MatchedEpoch
from rtkmesh_services.attitude.readings import VIRTUAL_LENGTH_M, Reading, SourceKind, SourceSpec, right_of

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class BodyAttitude:
    """What an epoch gives. ``used`` antennas; ``readings`` that are in it; ``missing`` sources with the reason.

    ``origin_ecef_m`` None: no position; ``ned_from_ecef`` there. ``measured``: what was judged, as one measurement. ``chosen``: what the
    geometry made of the integers, if it was asked.
    """

    time: GpsTime
    judged: Judged
    used: tuple[str, ...]
    readings: tuple[Reading, ...]
    missing: dict[str, str]
    origin_ecef_m: Vector | None
    ned_from_ecef: Matrix | None
    measured: Measured | None = None
    chosen: Chosen | None = None


def specs_of(table: AttitudeTable, deployment: Deployment) -> tuple[SourceSpec, ...]:
    """Return the sources of an attitude, in the order of the table."""
    found: list[SourceSpec] = []
    for name in (*((table.solver,) if table.solver else ()), *table.solvers):
        solver = deployment.solver[name]
        found.append(SourceSpec(name, SourceKind.BASELINE, solver.base, solver.rover))
    for name in table.positions:
        solver = deployment.solver[name]
        found.append(SourceSpec(name, SourceKind.POSITION, f"base {solver.base}", solver.rover))
    for name, heading in table.headings.items():
        found.append(SourceSpec(name, SourceKind.HEADING, *_ends(name, heading), heading))
    return tuple(found)


def layout_of(table: AttitudeTable) -> Layout:
    """Return the antennas of a table, and for every heading that is not of two of them the ends of its own line and one to its right."""
    places = {name: (antenna.position_m, antenna.sigmas_m) for name, antenna in table.antennas.items()}
    for name, heading in table.headings.items():
        if not heading.antennas:
            start, end = _ends(name, heading)
            places[start], places[end] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), (_direction(heading), (0.0, 0.0, 0.0))
            places[right_of(name)] = _to_the_right(heading), (0.0, 0.0, 0.0)
    blocks = {name: antenna.covariance_m2 for name, antenna in table.antennas.items()}
    cov = joint_covariance({name: sigmas for name, (_, sigmas) in places.items()}, blocks)
    positions = np.array([place for place, _ in places.values()], dtype=np.float64).reshape(-1, 3)
    return Layout(tuple(places), positions, cov)


class Body:
    """The antennas of a vehicle and what measures them."""

    def __init__(self, table: AttitudeTable, specs: Sequence[SourceSpec]) -> None:
        self.layout = layout_of(table)
        self.antennas = tuple(table.antennas)
        self._false_alarm = table.false_alarm
        self._own_lines = {name: _ends(name, heading) for name, heading in table.headings.items() if not heading.antennas}
        self._specs = {spec.id: spec for spec in specs}
        self._newest: tuple[list[Edge], Judged, Measured | None] = ([], Judged(None, Finding.NO_ATTITUDE), None)
        self.geometry = Geometry(self.layout, radians(table.max_tilt_deg), self._judged) if table.geometry and table.antennas else None

    def length_m(self, spec: SourceSpec) -> float:
        """Return the known distance (m) between a source's two ends."""
        return length_m(self.layout, spec.start, spec.end)

    def attitude(self, epoch: MatchedEpoch) -> BodyAttitude:
        """Return the attitude of an epoch."""
        chosen = self.choice(epoch)
        found = self._attitude(epoch if chosen is None else replace(epoch, readings=chosen.readings))
        if chosen is not None and chosen.suspects and found.judged.fit is not None:
            found = replace(found, judged=Judged(found.judged.fit, Finding.NOT_IDENTIFIABLE, suspects=chosen.suspects))
        return replace(found, chosen=chosen)

    def choice(self, epoch: MatchedEpoch) -> Chosen | None:
        """Return what the geometry makes of an epoch's integers; None where it is not asked."""
        return self.geometry.chosen(epoch) if self.geometry is not None and epoch.wanted else None

    def _attitude(self, epoch: MatchedEpoch) -> BodyAttitude:
        missing = {name: f"nothing of {name}" for name in epoch.missing}
        missing |= {name: reading.reason for name, reading in epoch.readings.items() if reading.edge is None}
        readings = _without_spares([reading for reading in epoch.readings.values() if reading.edge is not None])
        readings, origin, rotation = _in_ned(readings, epoch.time)
        found = self._judged(_edges(readings))
        if (line := self._line_at_fault(found)) is not None:
            rest = [reading for reading in readings if reading.source.id != line]
            missing[line] = f"{line} contradicts the others"
            return self._made(epoch, self._judged(_edges(rest)), rest, missing, origin, rotation)
        return self._made(epoch, found, readings, missing, origin, rotation)

    def _made(
        self,
        epoch: MatchedEpoch,
        found: Judged,
        readings: list[Reading],
        missing: dict[str, str],
        origin: Vector | None,
        rotation: Matrix | None,
    ) -> BodyAttitude:
        edges = _edges(readings)
        seen = {end for edge in edges for end in (edge.start, edge.end)} - set(found.excluded)
        used = tuple(name for name in self.antennas if name in seen)
        measured = self._newest[2] if edges == self._newest[0] else None
        return BodyAttitude(epoch.time, found, used, tuple(readings), missing, origin, rotation, measured)

    def _judged(self, edges: list[Edge]) -> Judged:
        """Return the attitude of edges; of the same ones again what it was."""
        if edges != self._newest[0]:
            self._newest = (edges, *self._judged_anew(edges))
        return self._newest[1]

    def _judged_anew(self, edges: list[Edge]) -> tuple[Judged, Measured | None]:
        if not edges:
            return Judged(None, Finding.NO_ATTITUDE), None
        try:
            measured = joint(self.layout, edges)
            found = judged(self.layout, measured, None, self._false_alarm)
        except np.linalg.LinAlgError:  # covariances of a stranger
            return Judged(None, Finding.NO_ATTITUDE), None
        if found.finding is Finding.OK and ((len(edges) == 1 and edges[0].alone) or self._is_one_line(edges)):
            return replace(found, finding=Finding.NO_REDUNDANCY), measured  # its lengths are ours, and test nothing
        return found, measured

    def _is_one_line(self, edges: list[Edge]) -> bool:
        """Return whether all is of one receiver that tells a whole attitude."""
        starts = {edge.start for edge in edges}
        return len(starts) == 1 and starts <= {start for start, _ in self._own_lines.values()}

    def _line_at_fault(self, found: Judged) -> str | None:
        """Return the heading whose own line of antennas is what disagrees: its two ends cannot be told apart, nor need they be."""
        blamed = {*found.suspects, *found.excluded}
        return next((name for name, ends in self._own_lines.items() if blamed and blamed <= {*ends, right_of(name)}), None)


def _edges(readings: Iterable[Reading]) -> list[Edge]:
    return [edge for reading in readings for edge in (reading.edge, reading.across) if edge is not None]


def _without_spares(readings: list[Reading]) -> list[Reading]:
    """Return the readings without headings of a pair whose baseline is there: both come from the same observations."""
    pairs = {frozenset((r.source.start, r.source.end)) for r in readings if r.source.kind is SourceKind.BASELINE}
    return [r for r in readings if r.source.kind is not SourceKind.HEADING or frozenset((r.source.start, r.source.end)) not in pairs]


def _in_ned(readings: list[Reading], time: GpsTime) -> tuple[list[Reading], Vector | None, Matrix | None]:
    """Return the readings with positions in NED about the first of them, and that origin with its rotation."""
    first = next((r.edge for r in readings if r.source.kind is SourceKind.POSITION and r.edge is not None), None)
    if first is None:
        return readings, None, None
    origin = first.vector_ned_m
    rotation = NED_FROM_ENU @ enu_from_ecef_at(origin)
    return [_moved(reading, time, origin, rotation) for reading in readings], origin, rotation


def _moved(reading: Reading, time: GpsTime, origin: Vector, rotation: Matrix) -> Reading:
    """Return a position about the origin, where it was at the epoch's time: receivers' tags and clocks differ by up to a millisecond."""
    if reading.source.kind is not SourceKind.POSITION or reading.edge is None:
        return reading
    velocity = np.array(reading.velocity_ecef_mps)
    moved = velocity * (time - reading.time + reading.clock_s) if np.isfinite(velocity).all() else np.zeros(3)
    return replace(reading, edge=replace(reading.edge, vector_ned_m=rotation @ (reading.edge.vector_ned_m + moved - origin)))


def _ends(name: str, heading: ReceiverHeadingTable) -> tuple[str, str]:
    return heading.antennas or (f"{name}: from", f"{name}: to")


def _direction(heading: ReceiverHeadingTable) -> tuple[float, float, float]:
    azimuth, elevation = radians(heading.mounting_deg), radians(heading.mounting_pitch_deg)
    level = VIRTUAL_LENGTH_M * cos(elevation)
    return level * cos(azimuth), level * sin(azimuth), -VIRTUAL_LENGTH_M * sin(elevation)


def _to_the_right(heading: ReceiverHeadingTable) -> tuple[float, float, float]:
    azimuth = radians(heading.mounting_deg)
    return -VIRTUAL_LENGTH_M * sin(azimuth), VIRTUAL_LENGTH_M * cos(azimuth), 0.0
