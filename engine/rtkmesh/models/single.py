"""Single-point positioning: position, receiver clocks and velocity of one epoch from codes and Dopplers alone."""

from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import lru_cache
from math import isfinite, nan, radians
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_index_table, scratch_table
from rtkmesh.gnss.constants import SECONDS_PER_WEEK, SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import KlobucharParameters
from rtkmesh.gnss.epoch import Epoch, Signals
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM, SYSTEMS, allowed_satellites
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.atmosphere import klobuchar_vector
from rtkmesh.models.code_selection import (
    CLOCK_OF_SYSTEM,
    CLOCKS,
    RATE_RESIDUAL,
    RATE_USED,
    RESIDUAL,
    USED,
    WORK,
    choose_codes,
    clocks_by_system,
    fill_work,
)
from rtkmesh.models.ephemeris_table import ROW, EphemerisTable, Issues, select_issues
from rtkmesh.models.geometry import AZIMUTH, ELEVATION, GEOMETRY
from rtkmesh.models.orbit import STATE, STATE_OK, satellite_states
from rtkmesh.models.rate_adjustment import adjust_velocity
from rtkmesh.models.single_adjustment import (
    CHI2,
    CONVERGED,
    FEW_SATELLITES,
    FREEDOM,
    NO_EPHEMERIS,
    PDOP,
    QUALITY,
    UNKNOWNS,
    adjust_position,
)

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
# A code that is so far off (m) is of a satellite that is not where its ephemeris puts it, or of a receiver that tracks something else. On 1
# April 2014 all of GLONASS sent ephemerides that were up to 200 km off in each coordinate, some for ten hours (Beutler et al. 2014). What
# reflections in streets add is less (simulated ones: up to 0.2 km).
MISPLACED_M: Final = 300.0
Plain = tuple[Any, ...]  # the fields of a named tuple: without names it crosses into a kernel sooner (rtk/crossing.py)


class IonosphereModel(StrEnum):
    """What stands for the ionosphere."""

    OFF = "off"
    KLOBUCHAR = "klobuchar"
    FREE = "ionosphere-free"  # two bands combined where a satellite has them, Klobuchar where not


class SingleStatus(IntEnum):
    """How the adjustment of the codes ended."""

    OK = 0
    NO_EPHEMERIS = 1  # codes, but of fewer than four satellites is it known where they are
    FEW_SATELLITES = 2  # fewer than unknowns (3 and a clock per system)
    NO_CONVERGENCE = 3
    INCONSISTENT = 4  # the codes contradict each other and too few are left to say which is wrong
    POOR_GEOMETRY = 5


@dataclass(frozen=True, slots=True)
class SinglePointOptions:
    """Options of single-point positioning; ``excluded`` are RINEX ids.

    Code sigma^2 = a^2 + (b / sin elevation)^2 + a part by C/N0 + broadcast accuracy + model errors.
    """

    systems: str = "GRECJ"
    elevation_mask_rad: float = radians(10.0)
    cn0_mask_dbhz: float = 0.0
    ionosphere: IonosphereModel = IonosphereModel.KLOBUCHAR
    troposphere: bool = True
    klobuchar: KlobucharParameters | None = None  # None: models.atmosphere.DEFAULT_KLOBUCHAR
    excluded: tuple[str, ...] = ()
    code_a_m: float = 0.3
    code_b_m: float = 0.3
    doppler_sigma_mps: float = 0.1
    maximum_pdop: float = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class SinglePoint:
    """The single-point solution of an epoch. Vectors are ECEF; columns are per satellite with a code; unknown is NaN.

    ``clock_s`` (7, in the order of ``SYSTEMS``) is receiver clock minus the system's time; the instant of reception in GPST is the
    epoch's tag minus ``receiver_clock_s``. ``rejected`` are satellite numbers that the exclusion put aside. Covariances are scaled by the
    variance of unit weight where that exceeds 1.
    """

    time: GpsTime
    status: SingleStatus
    position_ecef_m: Vector
    position_cov_ecef_m2: Matrix
    receiver_clock_s: float
    clock_s: Vector
    velocity_ecef_mps: Vector
    velocity_cov_ecef_m2ps2: Matrix
    clock_rate: float
    satellites: NDArray[np.int16]
    used: NDArray[np.bool_]
    azimuth_rad: Vector
    elevation_rad: Vector
    residual_m: Vector
    rate_residual_mps: Vector
    rejected: tuple[int, ...]
    chi_square: float
    degrees_of_freedom: int
    pdop: float

    @property
    def ok(self) -> bool:
        """Whether there is a position."""
        return self.status is SingleStatus.OK

    @property
    def has_velocity(self) -> bool:
        """Whether there is a velocity."""
        return bool(np.isfinite(self.velocity_ecef_mps[0]))


def single_point(
    epoch: Epoch, table: EphemerisTable, options: SinglePointOptions | None = None, initial_ecef_m: Vector | None = None
) -> SinglePoint:
    """Return the single-point solution of an epoch; without ``initial_ecef_m`` the iteration starts at the earth's centre."""
    options = options or SinglePointOptions()
    start = np.zeros(3) if initial_ecef_m is None else np.array(initial_ecef_m, np.float64)
    found = locate_epoch(epoch, table.issues, point_setup(options), start)
    satellites = found.satellites
    if found.status != CONVERGED:
        return _without_position(epoch.time, SingleStatus(found.status), satellites)
    work, states, geometry = found.work, found.states, found.geometry
    used = work[:, USED] != 0.0
    seen = (states[:, STATE_OK] != 0.0) & (geometry[:, ELEVATION] >= options.elevation_mask_rad)
    return SinglePoint(
        time=epoch.time,
        status=SingleStatus.OK,
        position_ecef_m=found.position_ecef_m,
        position_cov_ecef_m2=found.covariance_m2,
        receiver_clock_s=found.clock_s,
        clock_s=found.clocks_s,
        velocity_ecef_mps=found.velocity_mps[:3],
        velocity_cov_ecef_m2ps2=found.velocity_cov_m2ps2,
        clock_rate=float(found.velocity_mps[3]) / SPEED_OF_LIGHT_MPS,
        satellites=satellites,
        used=used,
        azimuth_rad=geometry[:, AZIMUTH].copy(),
        elevation_rad=geometry[:, ELEVATION].copy(),
        residual_m=work[:, RESIDUAL].copy(),
        rate_residual_mps=np.where(work[:, RATE_USED] != 0.0, work[:, RATE_RESIDUAL], nan),
        rejected=tuple(satellites[seen & ~used].tolist()),
        chi_square=float(found.quality[CHI2]),
        degrees_of_freedom=int(found.quality[FREEDOM]),
        pdop=float(found.quality[PDOP]),
    )


class PointSetup(NamedTuple):
    """Options of single-point positioning as kernels take them: the vector of ``adjust_position``, satellites by number."""

    adjustment: Vector
    allowed: NDArray[np.bool_]
    klobuchar: Vector
    cn0_mask_dbhz: float
    free_of_ionosphere: bool


def point_setup(options: SinglePointOptions) -> PointSetup:
    """Return the options for kernels."""
    return PointSetup(
        _adjustment(options), _allowed(options.systems, options.excluded), klobuchar_vector(options.klobuchar), options.cn0_mask_dbhz,
        options.ionosphere is IonosphereModel.FREE,
    )  # fmt: skip


class Located(NamedTuple):
    """What ``locate`` found; unknown is NaN. ``status`` is of SingleStatus, CONVERGED with a position.

    One row per satellite with a code: ``satellites`` (sorted), ephemeris ``rows``, ``states``, ``geometry``, ``work``. ``velocity_mps``
    has the clock's rate as fourth; ``clock_s`` is the receiver clock of the first system in use, GPS first, ``clocks_s`` the receiver clock
    minus the time of each system, in the order of ``SYSTEMS``; ``quality`` is chi-square and degrees of freedom of codes,
    PDOP, and the first two of range rates (NaN without velocity).
    """

    status: int
    position_ecef_m: Vector
    covariance_m2: Matrix
    clock_s: float
    clocks_s: Vector
    velocity_mps: Vector
    velocity_cov_m2ps2: Matrix
    quality: Vector
    satellites: NDArray[np.int16]
    rows: Matrix
    states: Matrix
    geometry: Matrix
    work: Matrix


def locate_epoch(epoch: Epoch, issues: Issues, setup: PointSetup, start_ecef_m: Vector) -> Located:
    """Find position and velocity of a receiver as ``locate`` does."""
    return Located(*_locate(epoch.plain_signals, tuple(issues), tuple(setup), start_ecef_m))


@kernel
def _locate(signals: Plain, issues: Plain, setup: Plain, start_ecef_m: Vector) -> Plain:
    found = locate(Signals(*signals), Issues(*issues), PointSetup(*setup), start_ecef_m)
    return (
        found.status, found.position_ecef_m, found.covariance_m2, found.clock_s, found.clocks_s, found.velocity_mps,
        found.velocity_cov_m2ps2, found.quality, found.satellites, found.rows, found.states, found.geometry, found.work,
    )  # fmt: skip


@kernel
def locate(signals: Signals, issues: Issues, setup: PointSetup, start_ecef_m: Vector) -> Located:
    """Find position and velocity from codes and Dopplers; the iteration starts at ``start_ecef_m`` (not finite: the earth's centre)."""
    chosen = scratch_index_table(len(signals.satellite), 2)
    count = choose_codes(
        signals.satellite, signals.signal, signals.pseudorange_m, signals.cn0_dbhz, setup.allowed, setup.cn0_mask_dbhz, chosen
    )
    satellites, codes_m = np.empty(count, np.int16), scratch(count)
    for k in range(count):
        satellites[k], codes_m[k] = signals.satellite[chosen[k, 0]], signals.pseudorange_m[chosen[k, 0]]
    rows, states, geometry = np.empty((count, ROW)), np.empty((count, STATE)), np.empty((count, GEOMETRY))
    work = np.zeros((count, WORK))
    select_issues(issues, satellites, signals.week * SECONDS_PER_WEEK + signals.tow_s, False, rows)
    fill_work(
        rows, signals.satellite, signals.signal, signals.channel, signals.pseudorange_m, signals.doppler_hz, signals.cn0_dbhz,
        signals.pseudorange_sigma_m, chosen[:count], setup.free_of_ionosphere, work,
    )  # fmt: skip
    position, clocks_m = start_ecef_m.copy(), scratch(CLOCKS)
    cofactor, quality = scratch_table(UNKNOWNS, UNKNOWNS), np.full(QUALITY, np.nan)
    velocity, rate_cofactor = np.full(4, np.nan), scratch_table(4, 4)
    clocks_m[:], rate_cofactor[:, :] = 0.0, np.nan
    if not np.isfinite(position[0] + position[1] + position[2]):
        position[:] = 0.0
    if satellite_states(rows, signals.week, signals.tow_s, codes_m, states) < 4:
        status = NO_EPHEMERIS if count >= 4 else FEW_SATELLITES
    else:
        status = adjust_position(
            work, states, geometry, signals.week, signals.tow_s, setup.klobuchar, setup.adjustment, position, clocks_m, cofactor, quality
        )
    if status != CONVERGED:
        position[:], cofactor[:, :], geometry[:, :] = np.nan, np.nan, np.nan
    elif adjust_velocity(work, states, geometry, setup.adjustment, position, velocity, rate_cofactor, quality) != CONVERGED:
        velocity[:], rate_cofactor[:, :] = np.nan, np.nan
    scale = max(1.0, quality[CHI2] / quality[FREEDOM]) if quality[FREEDOM] > 0.0 else 1.0
    clock_s, clocks_s = np.nan, np.full(len(CLOCK_OF_SYSTEM), np.nan)
    if status == CONVERGED:
        clock_s = clocks_by_system(work, clocks_m, clocks_s)
    return Located(
        status, position, scale * cofactor[:3, :3], clock_s, clocks_s, velocity, rate_cofactor[:3, :3].copy(), quality, satellites, rows,
        states, geometry, work,
    )  # fmt: skip


@kernel_in_place
def is_misplaced(located: Located, row: int) -> bool:
    """Return whether the others say that the satellite of a row is not where its ephemeris puts it: its phases are of no use either.

    Where they say it of all of a system, its clock is unknown.
    """
    if located.work[row, USED] != 0.0:
        return False
    clock_s = located.clocks_s[int(located.satellites[row]) // SATELLITES_PER_SYSTEM]
    return not (isfinite(clock_s) and abs(located.work[row, RESIDUAL]) <= MISPLACED_M)


_allowed = lru_cache(maxsize=64)(allowed_satellites)


@lru_cache(maxsize=64)
def _adjustment(options: SinglePointOptions) -> Vector:
    modelled = float(options.ionosphere is not IonosphereModel.OFF)
    return np.array((
        options.elevation_mask_rad, options.code_a_m, options.code_b_m, modelled, float(options.troposphere), options.maximum_pdop,
        options.doppler_sigma_mps,
    ))  # fmt: skip


def _without_position(time: GpsTime, status: SingleStatus, satellites: NDArray[np.int16]) -> SinglePoint:
    column, vector, matrix = np.full(len(satellites), nan), np.full(3, nan), np.full((3, 3), nan)
    return SinglePoint(
        time, status, vector, matrix, nan, np.full(len(SYSTEMS), nan), vector, matrix, nan, satellites,
        np.zeros(len(satellites), np.bool_), column, column, column, column, (), nan, 0, nan,
    )  # fmt: skip
