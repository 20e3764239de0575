"""The word ``status``: RTKRCV's list of parameters, from the solver's own values."""

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import sqrt
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import rtkmesh
from rtkmesh.gnss.signals import SYSTEMS
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.dilution import Dilution
from rtkmesh.rtk.overview import Overview, phase_dilution
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh_schemas.config import SolverTable
from rtkmesh_schemas.solution import Vector
from rtkmesh_services.solver.inputs import InputStream
from rtkmesh_services.solver.neighbours import Neighbours
from rtkmesh_services.solver.screens.satellites import SLOTS, finite
from rtkmesh_services.texts.geodesy import enu_rotation, geodetic, turned
from rtkmesh_services.texts.times import calendar, instant

_MODES: Final = {"dgps": "DGPS"}
_SOLUTIONS: Final = {"NONE": "-", "FIX": "fix", "FLOAT": "float", "SBAS": "SBAS", "DGPS": "DGPS", "SINGLE": "single"}
_NOWHERE: Final = (0.0, 0.0, 0.0)
_NO_TIME: Final = GpsTime(0, 0.0)
_SHOWN_SYSTEMS: Final = "RECI"  # against GPS, in RTKRCV's order
_TYPES: Final = 16  # RTCM message types of one input that are shown


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusView:
    """What the screen is made of."""

    counters: Mapping[str, int]
    table: SolverTable
    running: bool
    ran_s: float
    cycle_ms: float
    solve_ms: float
    interval_s: float
    solution: Solution | None
    overview: Overview
    inputs: Mapping[str, InputStream]
    neighbours: Neighbours
    antennas: Mapping[str, str]
    base_velocity_enu_mps: Vector = _NOWHERE


def status_screen(view: StatusView) -> str:
    """Return RTKRCV's lines ``parameter : value``."""
    lines = [("Parameter", "Value"), *_server(view), *_data(view), *_epoch(view), *_positions(view)]
    return "".join(f"{name:<28s}: {value}\n" for name, value in lines)


def status_data(view: StatusView) -> dict[str, Any]:
    """Return what the screen shows beside the status, for ``Reply.data``."""
    solution, dops = view.solution, dilution_of(view)
    return {
        "missing_epochs": _missing(view),
        "waiting_epochs": view.counters.get("waiting", 0),
        "solution_interval_s": view.interval_s,
        "dilution": {name: getattr(dops, name) for name in dops._fields},
        "clocks_s": {} if solution is None else dict(zip(SYSTEMS, solution.clocks_s.tolist(), strict=True)),
        "states_of_motion": view.overview.states_of_motion,
        "states": view.overview.states,
        "float_position_ecef_m": [] if solution is None else solution.float_state.position_ecef_m.tolist(),
        "float_sigma_ecef_m": list(_sigmas(view.overview.float_cov_m2)),
        "rtcm_messages": {name: _rtcm_counts(view, name) for name in view.neighbours.receivers},
        "ran_s": view.ran_s,
    }


def _server(view: StatusView) -> Iterator[tuple[str, str]]:
    hours, rest = divmod(view.ran_s, 3600.0)
    yield "rtklib version", f"rtkmesh {rtkmesh.__version__}"
    yield "rtk server thread", str(os.getpid())
    yield "rtk server state", "run" if view.running else "stop"
    yield "processing cycle (ms)", f"{view.cycle_ms:.0f}"
    yield "positioning mode", _MODES.get(view.table.mode, view.table.mode)
    yield "frequencies", "+".join(SLOTS[: view.table.frequencies])
    yield "accumulated time to run", f"{int(hours):02d}:{int(rest // 60.0):02d}:{rest % 60.0:04.1f}"
    yield "cpu time for a cycle (ms)", f"{view.solve_ms:.0f}"
    yield "missing obs data count", str(_missing(view))
    yield "bytes in input buffer", "0,0"  # bytes wait in ingests; epochs that wait here are told in ``waiting_epochs``


def _missing(view: StatusView) -> int:
    """Return how many epochs or messages did not get to the engine: lost on the way, too late, or too many."""
    early = sum(view.counters.get(name, 0) for name in ("rover_dropped", "rover_late"))
    return early + sum(stream.sequencer.lost for stream in view.inputs.values())


def _data(view: StatusView) -> Iterator[tuple[str, str]]:
    table = view.table
    corrections = [name for name in view.inputs if name not in (table.rover, table.base)]
    named = [("rover", [table.rover]), ("base", [table.base] if table.base else []), ("corr", corrections)]
    for word, names in named:
        yield f"# of input data {word}", _counts([view.inputs[name] for name in names if name in view.inputs])
    for word, names in named:
        counts = Counter[str]()
        for name in names:
            counts.update(_rtcm_counts(view, name))
        yield f"# of rtcm messages {word}", ",".join(f"{kind}({count})" for kind, count in sorted(counts.items())[:_TYPES])


def _counts(streams: list[InputStream]) -> str:
    total, glonass, errors = Counter[str](), 0, 0
    for stream in streams:
        total.update(stream.messages)
        glonass, errors = glonass + stream.glonass, errors + stream.errors
    counts = {"obs": total["obs"], "nav": total["eph"] - glonass, "gnav": glonass, "ion": total["iono"], "sbs": 0, "pos": total["ref"]}
    return ",".join(f"{name}({count})" for name, count in (counts | {"dgps": 0, "ssr": 0, "err": errors}).items())


def _rtcm_counts(view: StatusView, receiver: str) -> dict[str, int]:
    """Return the RTCM 3 messages of a receiver by type, as its ingest counts them."""
    status = view.neighbours.of(receiver).status()
    rows = [] if status is None else status.inputs
    frames = [row.stream.frames for row in rows if row.stream is not None]
    return {kind.removeprefix("rtcm3/"): told.count for found in frames for kind, told in found.items() if kind.startswith("rtcm3/")}


def dilution_of(view: StatusView) -> Dilution:
    """Return the dilution of the satellites in use: of the relative solution, else of the single point."""
    solution = view.solution
    if solution is not None and len(solution.satellites.packed):
        return phase_dilution(solution.satellites)
    return view.overview.code_dilution


def _epoch(view: StatusView) -> Iterator[tuple[str, str]]:
    solution, dops = view.solution, dilution_of(view)
    yield "solution status", "-" if solution is None else _SOLUTIONS[solution.status.name]
    yield "time of receiver clock rover", "-" if solution is None else _receiver_time(solution)
    yield "time sys offset (ns)", ",".join(f"{1e9 * offset:.3f}" for offset in _system_offsets(solution))
    yield "solution interval (s)", f"{view.interval_s:.3f}"
    yield "age of differential (s)", f"{0.0 if solution is None else finite(solution.age_s):.3f}"
    yield "ratio for ar validation", f"{0.0 if solution is None else finite(solution.ratio):.3f}"
    yield "# of satellites rover", str(0 if solution is None else solution.satellites_rover)
    yield "# of satellites base", str(0 if solution is None else solution.satellites_base)
    yield "# of valid satellites", str(0 if solution is None else solution.satellites_used)
    yield "GDOP/PDOP/HDOP/VDOP", ",".join(f"{finite(value):.1f}" for value in dops)
    yield "# of real estimated states", str(view.overview.states_of_motion)
    yield "# of all estimated states", str(view.overview.states)


def _receiver_time(solution: Solution) -> str:
    """Return the true time of reception: the epoch's tag without the receiver's clock."""
    time = solution.time + -finite(solution.receiver_clock_s)
    return calendar(instant(time.week, time.tow_s), 9)


def _system_offsets(solution: Solution | None) -> Iterator[float]:
    """Yield the times of the other systems against GPS (s), 0 where one of the two is not known."""
    clocks = np.full(len(SYSTEMS), np.nan) if solution is None else solution.clocks_s
    for system in _SHOWN_SYSTEMS:
        yield finite(float(clocks[SYSTEMS.index(system)] - clocks[SYSTEMS.index("G")]))


def _positions(view: StatusView) -> Iterator[tuple[str, str]]:
    solution, table = view.solution or Solution(time=_NO_TIME), view.table
    single, found = _vector(solution.single_position_ecef_m), _vector(solution.float_state.position_ecef_m)
    fixed = _vector(solution.position_ecef_m) if solution.status is Status.FIX else _NOWHERE
    fixed_sigmas = _sigmas(solution.position_cov_ecef_m2) if solution.status is Status.FIX else _NOWHERE
    base = _vector(solution.base_ecef_m)
    yield "pos xyz single (m) rover", _xyz(single)
    yield "pos llh single (deg,m) rover", _llh(single)
    yield "vel enu (m/s) rover", _xyz(_in_enu(_vector(solution.velocity_ecef_mps), single))
    yield "pos xyz float (m) rover", _xyz(found)
    yield "pos xyz float std (m) rover", _xyz(_sigmas(view.overview.float_cov_m2) if found != _NOWHERE else _NOWHERE)
    yield "pos xyz fixed (m) rover", _xyz(fixed)
    yield "pos xyz fixed std (m) rover", _xyz(fixed_sigmas)
    yield "pos xyz (m) base", _xyz(base)
    yield "pos llh (deg,m) base", _llh(base)
    yield "# of average single pos base", "0"  # an ingest averages its own position, and says so in its status
    yield "ant type rover", table.rover_antenna or view.antennas.get("rover", "")
    yield "ant delta rover", "0.000 0.000 0.000"  # positions are of antenna reference points
    yield "ant type base", table.base_antenna or view.antennas.get("base", "")
    yield "ant delta base", "0.000 0.000 0.000"
    yield "vel enu (m/s) base", _xyz(view.base_velocity_enu_mps)
    yield "baseline length float (m)", f"{_length(found, base):.3f}"
    yield "baseline length fixed (m)", f"{_length(fixed, base):.3f}"
    yield "monitor port", "0"


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = (finite(value) for value in values.tolist())
    return x, y, z


def _sigmas(covariance: NDArray[np.float64]) -> Vector:
    x, y, z = (sqrt(max(finite(value), 0.0)) for value in np.diag(covariance).tolist())
    return x, y, z


def _xyz(vector: Vector) -> str:
    return ",".join(f"{value:.3f}" for value in vector)


def _llh(position_ecef_m: Vector) -> str:
    if position_ecef_m == _NOWHERE:
        return "0.00000000,0.00000000,0.000"
    lat_rad, lon_rad, height_m = geodetic(position_ecef_m)
    return f"{np.degrees(lat_rad):.8f},{np.degrees(lon_rad):.8f},{height_m:.3f}"


def _in_enu(vector: Vector, position_ecef_m: Vector) -> Vector:
    if position_ecef_m == _NOWHERE:
        return _NOWHERE
    lat_rad, lon_rad, _ = geodetic(position_ecef_m)
    return turned(enu_rotation(lat_rad, lon_rad), vector)


def _length(rover: Vector, base: Vector) -> float:
    if _NOWHERE in (rover, base):
        return 0.0
    return sqrt(sum((one - other) ** 2 for one, other in zip(rover, base, strict=True)))
