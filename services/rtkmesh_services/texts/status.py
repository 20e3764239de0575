"""RTKLIB's solution status: records $POS, $VELACC, $CLK, $ION, $TROP, $HWBIAS and, of satellites, $SAT.

As demo5 writes them (rtkpos.c, rtkopenstat), or 2.4.2 with four clocks and a shorter $SAT. What is not known is 0.
"""

from collections.abc import Iterable, Iterator, Sequence
from math import isfinite
from typing import Final

from rtkmesh_schemas.solution import SatellitesMessage, SolutionMessage
from rtkmesh_services.texts.geodesy import Matrix, Vector, enu_rotation, geodetic, known, turned
from rtkmesh_services.texts.options import TextOptions
from rtkmesh_services.texts.status_satellites import ionosphere, rows_of, satellite

_FIX: Final = 1
_RELATIVE: Final = (1, 2, 4)  # Q of solutions that have a float solution beside them
_NOTHING: Final = (0.0, 0.0, 0.0)
_NANOSECONDS: Final = 1e9
_GPS: Final = 0  # of clocks_s, in the order GRECJSI; the others as $CLK has them
_OTHER_CLOCKS: Final = {"demo5": (1, 2, 3, 6, 4), "2.4": (1, 2, 3)}
_MHZ_PER_CHANNEL: Final = (0.5625, 0.4375)  # GLONASS L1 and L2


def status(solution: SolutionMessage, satellites: SatellitesMessage | None, options: TextOptions) -> str:
    """Return the records of an epoch; "" without a solution. Records of satellites have the time of their own message."""
    if solution.status <= 0 or not known(solution.position_ecef_m):
        return ""
    records = _states(solution, options)
    if satellites is not None:
        rows, time = rows_of(satellites), _time(satellites)
        records[3:3] = [f"$ION,{time},{solution.status},{record}" for record in ionosphere(rows)]
        if options.status == "residual":
            records += [f"$SAT,{time},{satellite(row, options.dialect)}" for row in rows]
    return options.newline.join([*records, ""])


def _time(message: SolutionMessage | SatellitesMessage) -> str:
    return f"{message.week},{message.tow_s:.3f}"


def _states(solution: SolutionMessage, options: TextOptions) -> list[str]:
    """Return the records of states; those of the ionosphere belong behind the third."""
    head = f"{_time(solution)},{solution.status}"
    return [
        f"$POS,{head},{_numbers(_float_position(solution), 4)},{_numbers(_if_fixed(solution, solution.position_ecef_m), 4)}",
        f"$VELACC,{head},{_motion(solution)}",
        f"$CLK,{head},1,{_numbers(_clocks_ns(solution, options), 3)}",
        *(f"$TROP,{head},{record}" for record in _numbered(solution.zenith_delays_m)),
        *(f"$HWBIAS,{head},{record}" for record in _numbered(_bias_per_mhz(solution))),
    ]


def _bias_per_mhz(solution: SolutionMessage) -> Iterator[float]:
    """Return what phases on G1 and on G2 are off per frequency (m/MHz)."""
    return (slope_m / mhz for slope_m, mhz in zip(solution.glonass_slopes_m, _MHZ_PER_CHANNEL, strict=True))


def _float_position(solution: SolutionMessage) -> Vector:
    given = solution.status in _RELATIVE and known(solution.float_position_ecef_m)
    return solution.float_position_ecef_m if given else solution.position_ecef_m


def _if_fixed(solution: SolutionMessage, values: Vector) -> Vector:
    return values if solution.status == _FIX else _NOTHING


def _motion(solution: SolutionMessage) -> str:
    """Return velocity and acceleration, floating and fixed; of a filter without motion the velocity by Dopplers, and no more."""
    rotation = enu_rotation(*geodetic(solution.position_ecef_m)[:2])
    velocity, acceleration = solution.float_velocity_ecef_mps, solution.float_acceleration_ecef_mps2
    if solution.status not in _RELATIVE or not known(velocity) or not known(acceleration):
        return f"{_turned(rotation, solution.velocity_ecef_mps, _NOTHING)},{_turned(rotation, _NOTHING, _NOTHING)}"
    fixed = (_if_fixed(solution, values) for values in (solution.velocity_ecef_mps, solution.acceleration_ecef_mps2))
    return f"{_turned(rotation, velocity, acceleration)},{_turned(rotation, *fixed)}"


def _turned(rotation: Matrix, velocity: Vector, acceleration: Vector) -> str:
    return f"{_numbers(turned(rotation, velocity), 4)},{_numbers(turned(rotation, acceleration), 5)}"


def _clocks_ns(solution: SolutionMessage, options: TextOptions) -> list[float]:
    """Return the receiver clock against GPS time, and against the other systems' relative to it (ns)."""
    clocks_s = solution.clocks_s
    gps_s = clocks_s[_GPS] if isfinite(clocks_s[_GPS]) else solution.receiver_clock_s
    return [gps_s * _NANOSECONDS, *((clocks_s[k] - gps_s) * _NANOSECONDS for k in _OTHER_CLOCKS[options.dialect])]


def _numbered(values: Iterable[float]) -> Iterator[str]:
    """Yield number, value and the value of a fix (which is not told) of what is known."""
    yield from (f"{number},{value:.4f},{0.0:.4f}" for number, value in enumerate(values, 1) if isfinite(value))


def _numbers(values: Sequence[float], decimals: int) -> str:
    return ",".join(f"{value if isfinite(value) else 0.0:.{decimals}f}" for value in values)
