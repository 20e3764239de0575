"""Faults of ``[attitude.ID]``: sources that are none, antennas without a place, lengths that contradict each other."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from math import dist, hypot, isclose
from typing import Final

from rtkmesh_schemas.config import Deployment, SolverTable
from rtkmesh_schemas.config_attitude import LARGEST_SIGMA_M, AntennaPlaceTable, AttitudeTable, Place
from rtkmesh_services.runtime.file_faults import Faults
from rtkmesh_services.runtime.words import nearest

SAME_PLACE_M: Final = 0.01
SOLVER_RISK: Final = 1e-5  # of the engine, where a solver's table names none
_STRAIGHT: Final = 1e-3
_SLACK: Final = 1.01  # of a correlation of one: rounded numbers
_TOLERANCE_SIGMAS: Final = 3.0
_LEAST_TOLERANCE_M: Final = 0.02
_MOUNTING: Final = ("mounting_deg", "mounting_pitch_deg", "length_m")


def check_attitude(reader: Faults, id: str, table: AttitudeTable, deployment: Deployment) -> None:  # noqa: A002  the word of the design
    """Gather the faults of one table whose references are right."""
    if not table.sources:
        reader.fault(("attitude", id), f"[attitude.{id}] has no 'solver', 'solvers', 'positions' or 'headings': what it is made of")
    for path, message in _faults(id, table, deployment):
        reader.fault(("attitude", id, *path), f"[attitude.{id}] {message}")


def notes_on(id: str, table: AttitudeTable, deployment: Deployment) -> Iterator[str]:  # noqa: A002
    """Yield what is no fault, and worth to know, of a table's antennas and solvers."""
    for name in (*((table.solver,) if table.solver else ()), *table.solvers):
        solver = deployment.solver.get(name)
        if solver is not None and solver.baseline_length_m is None and (length_m := _known_length_m(table, solver)) is not None:
            yield f"[solver.{name}] fixes sooner with 'baseline_length_m = {length_m:.3f}', which [attitude.{id}] knows"
        if solver is not None:
            yield from _other_risk(name, solver, id, table)
    if len(table.antennas) > 2 and on_one_line([antenna.position_m for antenna in table.antennas.values()]):
        yield f"[attitude.{id}] its {len(table.antennas)} antennas are on one line: the tilt about it is not seen"


def risk_of(solver: SolverTable) -> float:
    """Return the risk of a solver's protection levels."""
    return SOLVER_RISK if solver.integrity.risk is None else solver.integrity.risk


def _other_risk(name: str, solver: SolverTable, attitude: str, table: AttitudeTable) -> Iterator[str]:
    risk = risk_of(solver)
    if risk != table.integrity.risk:
        levels = "infinite" if risk > table.integrity.risk else f"of a risk of {risk:g}"
        theirs = f"[attitude.{attitude}.integrity] has {table.integrity.risk:g}"
        yield f"[solver.{name}.integrity] has risk {risk:g}, {theirs}: levels of two antennas are {levels}"


def _known_length_m(table: AttitudeTable, solver: SolverTable) -> float | None:
    """Return the length (m) of a solver's baseline that its attitude knows."""
    ends = [table.antennas[name].position_m for name in (solver.base, solver.rover) if name in table.antennas]
    return dist(*ends) if len(ends) == 2 else table.length_m


def on_one_line(places: Sequence[Place]) -> bool:
    """Return whether places (m) are on one line, to a thousandth of its length."""
    start = places[0]
    end = max(places, key=lambda place: dist(place, start))
    length = dist(start, end)
    return all(_off_line(place, start, end) <= _STRAIGHT * length**2 for place in places)


def _off_line(place: Place, start: Place, end: Place) -> float:
    """Return the distance of a place from the line, times its length: the size of the cross product."""
    (ax, ay, az), (bx, by, bz) = ([q - p for p, q in zip(start, to, strict=True)] for to in (place, end))
    return hypot(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def _faults(id: str, table: AttitudeTable, deployment: Deployment) -> Iterator[tuple[tuple[str, ...], str]]:  # noqa: A002
    yield from _modes(table, deployment)
    if table.filter is None and table.imu is not None:
        yield ("imu",), f"imu is for a filter: write [attitude.{id}.filter]"
    if table.filter is not None and table.filter.publish == "gyro" and table.imu is None:
        yield ("filter", "publish"), f"filter: publish = 'gyro' needs [attitude.{id}.imu]"
    if table.filter is not None and not (table.antennas or table.headings):
        yield ("filter",), f"filter needs the places of the antennas: write [attitude.{id}.antennas.NAME]"
    yield from _course(id, table)
    if not (table.antennas or table.solvers or table.positions or table.headings):
        return
    yield from _places(id, table, deployment)
    yield from _lengths(table, deployment)
    for name in _MOUNTING:
        if table.antennas and getattr(table, name) not in (None, 0.0):
            yield (name,), f"{name} and the places of antennas: say it by the places"


def _course(id: str, table: AttitudeTable) -> Iterator[tuple[tuple[str, ...], str]]:  # noqa: A002
    if table.course is None:
        return
    if table.filter is None:
        yield ("course",), f"course is for a filter: write [attitude.{id}.filter]"
    if table.course.position not in table.positions:
        near = nearest(table.course.position, list(table.positions))
        yield ("course", "position"), f"course: {table.course.position!r} is none of its positions{near}"


def _modes(table: AttitudeTable, deployment: Deployment) -> Iterator[tuple[tuple[str, ...], str]]:
    for index, name in enumerate(table.solvers):
        if (solver := deployment.solver.get(name)) is not None and solver.mode != "moving-base":
            text = f"solvers: [solver.{name}] is of mode {solver.mode!r}, baselines need 'moving-base'; positions belong to 'positions'"
            yield ("solvers", str(index)), text
    for index, name in enumerate(table.positions):
        if (solver := deployment.solver.get(name)) is not None and solver.mode == "moving-base":
            yield ("positions", str(index)), f"positions: [solver.{name}] is of mode 'moving-base': it belongs to 'solvers'"


def _places(id: str, table: AttitudeTable, deployment: Deployment) -> Iterator[tuple[tuple[str, ...], str]]:  # noqa: A002
    """Yield antennas that sources are of and that have no place, and those at one place."""
    for key, name, antenna in _measured(table, deployment):
        if antenna not in table.antennas:
            near = nearest(antenna, list(table.antennas))
            yield (key,), f"{key}: {name!r} is of antenna {antenna!r}, which has no place: write [attitude.{id}.antennas.{antenna}]{near}"
    for antenna in table.antennas:
        if antenna not in deployment.ingest:
            there = nearest(antenna, list(deployment.ingest))
            yield ("antennas", antenna), f"antennas: no [ingest.{antenna}], whose antenna this would be{there}"
        if not all(0.0 <= sigma <= LARGEST_SIGMA_M for sigma in table.antennas[antenna].sigmas_m):
            yield ("antennas", antenna, "sigma_m"), f"antennas: sigma_m of {antenna!r} must be 0 to {LARGEST_SIGMA_M:.0f} m"
        yield from _covariances(antenna, table)
    for (first, one), (second, other) in combinations(table.antennas.items(), 2):
        if dist(one.position_m, other.position_m) < SAME_PLACE_M:
            yield ("antennas", second), f"antennas: {first!r} and {second!r} are at one place"


def _covariances(name: str, table: AttitudeTable) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield covariances of an antenna that are with none, or larger than variances allow."""
    mine, path = _variances(name, table), ("antennas", name, "covariance_m2")
    for other, block in table.antennas[name].covariance_m2.items():
        theirs = _variances(other, table) if other in table.antennas else None
        if theirs is None:
            yield (*path, other), f"antennas: covariance_m2 of {name!r} with {other!r}, which is none{nearest(other, list(table.antennas))}"
        elif other == name and min(block[::4]) < 0.0:
            yield (*path, other), f"antennas: covariance_m2 of {name!r} has negative variances"
        elif mine and theirs and any(block[3 * i + j] ** 2 > _SLACK * mine[i] * theirs[j] for i in range(3) for j in range(3)):
            yield (*path, other), f"antennas: covariance_m2 of {name!r} with {other!r} is larger than their variances allow"


def _variances(name: str, table: AttitudeTable) -> tuple[float, ...]:
    """Return the variances (m^2) of an antenna's place by its covariance; empty without one."""
    return table.antennas[name].covariance_m2.get(name, ())[::4]


def _measured(table: AttitudeTable, deployment: Deployment) -> Iterator[tuple[str, str, str]]:
    """Yield (key, source, antenna) of all sources that are of antennas."""
    baselines = [("solver", table.solver)] if table.solver and table.antennas else []
    for key, name in (*baselines, *(("solvers", name) for name in table.solvers), *(("positions", name) for name in table.positions)):
        if (solver := deployment.solver.get(name)) is not None:
            yield from ((key, name, antenna) for antenna in _ends(key, solver))
    for name, heading in table.headings.items():
        yield from (("headings", name, antenna) for antenna in heading.antennas or ())


def _ends(key: str, solver: SolverTable) -> tuple[str, ...]:
    return (solver.rover,) if key == "positions" else (solver.base, solver.rover)


def _lengths(table: AttitudeTable, deployment: Deployment) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield solvers that were told another length of their baseline than the places of its antennas give."""
    for index, name in enumerate(table.solvers):
        solver = deployment.solver.get(name)
        ends = [] if solver is None else [table.antennas[end] for end in (solver.base, solver.rover) if end in table.antennas]
        if solver is None or solver.baseline_length_m is None or len(ends) != 2:
            continue
        length_m = dist(ends[0].position_m, ends[1].position_m)
        if not isclose(length_m, solver.baseline_length_m, rel_tol=0.0, abs_tol=_tolerance_m(solver, *ends)):
            told = f"baseline_length_m = {solver.baseline_length_m}"
            yield ("solvers", str(index)), f"solvers: [solver.{name}] has {told}, the places of its antennas give {length_m:.3f} m"


def _tolerance_m(solver: SolverTable, one: AntennaPlaceTable, other: AntennaPlaceTable) -> float:
    return max(_LEAST_TOLERANCE_M, _TOLERANCE_SIGMAS * hypot(solver.baseline_sigma_m, max(one.sigmas_m), max(other.sigmas_m)))
