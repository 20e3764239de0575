"""What filters remember of phases when satellites have other ephemerides.

Every two hours most satellites of a system change theirs in one second. Phases less their models then change by metres, those of both
receivers alike. What is remembered is brought to the new ephemeris, at the instants at which it was observed, so that time differences are
of one model always: a slip in that second is found as in any other, and nobody seems to have moved.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch, scratch_table
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.signals import KEYS_PER_SATELLITE, MAX_SATELLITE
from rtkmesh.models.ephemeris_table import KIND, NO_EPHEMERIS, ROW
from rtkmesh.models.geometry import E_Z, RANGE, line_of_sight
from rtkmesh.models.orbit import STATE, STATE_CLOCK, STATE_OK, satellite_states
from rtkmesh.rtk.state import BASE_M, BASE_S, FIRST_PAIR_KEY, ROVER_M, ROVER_S, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

_FLIGHT_M: Final = 0.08 * SPEED_OF_LIGHT_MPS  # of any signal: two ephemerides come apart by millimetres a second


def no_ephemerides() -> Matrix:
    """Return room for the ephemerides (MAX_SATELLITE, ROW) that phases were modelled with, by satellite number; none is known."""
    return np.zeros((MAX_SATELLITE, ROW))


@kernel_in_place
def are_new(rows: Matrix, satellites: NDArray[np.int16], known: Matrix) -> bool:
    """Return whether one of these ephemerides is another than the one that is known of its satellite."""
    new = False
    for i in range(len(satellites)):
        new = new or _is_new(rows[i], known[satellites[i]])
    return new


@kernel_in_place
def _is_new(row: Vector, known: Vector) -> bool:
    new = False
    for k in range(len(row)):
        new = new or row[k] != known[k]
    return new and row[KIND] != NO_EPHEMERIS


@kernel_in_place
def learn_ephemerides(rows: Matrix, satellites: NDArray[np.int16], known: Matrix) -> None:
    """Let these ephemerides be the known ones of their satellites."""
    for i in range(len(satellites)):
        if rows[i, KIND] != NO_EPHEMERIS:
            _copy(rows[i], known[satellites[i]])


@kernel_in_place
def _copy(row: Vector, out: Vector) -> None:
    for k in range(len(row)):
        out[k] = row[k]


@kernel_in_place
def change_ephemerides(
    f: Filter, rows: Matrix, satellites: NDArray[np.int16], known: Matrix, clock: tuple[int, float, float],
    places_ecef_m: tuple[Vector, Vector],
) -> None:  # fmt: skip
    """Let the phases that a filter remembers be less the models of these ephemerides in place of those of the ``known`` ones.

    ``clock`` is the filter's: week and time of week (s) of its origin, and 1 or -1 as it runs forward or backward. Places, of rover and
    base, are those of now: a kilometre changes a range by another ephemeris by a tenth of a millimetre. NaN where an ephemeris says nothing
    of the instant.
    """
    i = 0
    for row in range(len(f.keys)):
        if f.keys[row] < FIRST_PAIR_KEY:
            continue
        satellite = f.keys[row] // KEYS_PER_SATELLITE
        while i < len(satellites) and satellites[i] < satellite:
            i += 1
        if i == len(satellites):
            return
        if satellites[i] != satellite or not _is_new(rows[i], known[satellite]):
            continue
        h = f.history[row]
        h[ROVER_M] -= _change_m(known[satellite], rows[i], clock, h[ROVER_S], places_ecef_m[0])
        h[BASE_M] -= _change_m(known[satellite], rows[i], clock, h[BASE_S], places_ecef_m[1])


@kernel_in_place
def _change_m(old: Vector, new: Vector, clock: tuple[int, float, float], time_s: float, place_ecef_m: Vector) -> float:
    """Return by how much another ephemeris changes what a phase should measure (m) at an instant of the filter's clock."""
    rows, codes_m, states, way = scratch_table(2, ROW), scratch(2), scratch_table(2, STATE), scratch_table(2, E_Z + 1)
    codes_m[:] = _FLIGHT_M
    _copy(old, rows[0])
    _copy(new, rows[1])
    satellite_states(rows, clock[0], clock[1] + clock[2] * time_s, codes_m, states)
    if states[0, STATE_OK] == 0.0 or states[1, STATE_OK] == 0.0:
        return np.nan
    for i in range(2):
        line_of_sight(states[i], place_ecef_m, way[i])
    clocks_m = SPEED_OF_LIGHT_MPS * (states[1, STATE_CLOCK] - states[0, STATE_CLOCK])
    return way[1, RANGE] - way[0, RANGE] - clocks_m
