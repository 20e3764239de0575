"""Single-point positioning: position, receiver clocks and velocity of one epoch from codes and Dopplers alone."""

from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import lru_cache
from math import nan, radians

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import KlobucharParameters
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import MAX_SATELLITE, SATELLITES_PER_SYSTEM, SYSTEMS, satellite_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.atmosphere import klobuchar_vector
from rtkmesh.models.code_selection import (
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
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.geometry import AZIMUTH, ELEVATION, GEOMETRY
from rtkmesh.models.orbit import STATE, STATE_OK, satellite_states
from rtkmesh.models.single_adjustment import CONVERGED, QUALITY, UNKNOWNS, adjust_position, adjust_velocity

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


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
    chosen = _choose(epoch, options)
    count, satellites = len(chosen), epoch.satellite[chosen[:, 0]]
    rows = table.select(satellites, epoch.time)
    work, states, geometry = np.zeros((count, WORK)), np.empty((count, STATE)), np.empty((count, GEOMETRY))
    fill_work(
        rows, epoch.satellite, epoch.signal, epoch.channel, epoch.pseudorange_m, epoch.doppler_hz, epoch.cn0_dbhz,
        epoch.pseudorange_sigma_m, chosen, options.ionosphere is IonosphereModel.FREE, work,
    )  # fmt: skip
    valid = satellite_states(rows, epoch.time.week, epoch.time.tow_s, epoch.pseudorange_m[chosen[:, 0]], states)
    if valid < 4:
        status = SingleStatus.NO_EPHEMERIS if count >= 4 else SingleStatus.FEW_SATELLITES
        return _without_position(epoch.time, status, satellites)
    position = np.zeros(3) if initial_ecef_m is None or not np.isfinite(initial_ecef_m).all() else np.array(initial_ecef_m, np.float64)
    clocks_m, cofactor, quality = np.zeros(CLOCKS), np.empty((UNKNOWNS, UNKNOWNS)), np.empty(QUALITY)
    setup = _setup(options)
    status = adjust_position(
        work, states, geometry, epoch.time.week, epoch.time.tow_s, klobuchar_vector(options.klobuchar), setup, position, clocks_m,
        cofactor, quality,
    )  # fmt: skip
    if status != CONVERGED:
        return _without_position(epoch.time, SingleStatus(status), satellites)
    velocity, rate_covariance = np.zeros(4), np.empty((4, 4))
    if adjust_velocity(work, states, geometry, setup, position, velocity, rate_covariance) != CONVERGED:
        velocity[:], rate_covariance[:] = nan, nan
    used = work[:, USED] != 0.0
    seen = (states[:, STATE_OK] != 0.0) & (geometry[:, ELEVATION] >= options.elevation_mask_rad)
    clock_s = np.empty(len(SYSTEMS))
    receiver_clock_s = clocks_by_system(work, clocks_m, clock_s)
    scale = max(1.0, quality[0] / quality[1]) if quality[1] > 0.0 else 1.0
    return SinglePoint(
        time=epoch.time,
        status=SingleStatus.OK,
        position_ecef_m=position,
        position_cov_ecef_m2=scale * cofactor[:3, :3],
        receiver_clock_s=receiver_clock_s,
        clock_s=clock_s,
        velocity_ecef_mps=velocity[:3],
        velocity_cov_ecef_m2ps2=rate_covariance[:3, :3],
        clock_rate=float(velocity[3]) / SPEED_OF_LIGHT_MPS,
        satellites=satellites,
        used=used,
        azimuth_rad=geometry[:, AZIMUTH].copy(),
        elevation_rad=geometry[:, ELEVATION].copy(),
        residual_m=work[:, RESIDUAL].copy(),
        rate_residual_mps=np.where(work[:, RATE_USED] != 0.0, work[:, RATE_RESIDUAL], nan),
        rejected=tuple(satellites[seen & ~used].tolist()),
        chi_square=float(quality[0]),
        degrees_of_freedom=int(quality[1]),
        pdop=float(quality[2]),
    )


def _choose(epoch: Epoch, options: SinglePointOptions) -> NDArray[np.int64]:
    """Return the rows of the epoch (n, 2) whose codes serve; see ``choose_codes``."""
    chosen = np.empty((len(epoch), 2), np.int64)
    allowed = _allowed(options.systems, options.excluded)
    count = choose_codes(epoch.satellite, epoch.signal, epoch.pseudorange_m, epoch.cn0_dbhz, allowed, options.cn0_mask_dbhz, chosen)
    return chosen[:count]


@lru_cache(maxsize=64)
def _allowed(systems: str, excluded: tuple[str, ...]) -> NDArray[np.bool_]:
    """Return by satellite number whether it may be used."""
    allowed = np.zeros(MAX_SATELLITE, np.bool_)
    for letter in systems:
        first = SYSTEMS.index(letter) * SATELLITES_PER_SYSTEM
        allowed[first : first + SATELLITES_PER_SYSTEM] = True
    for name in excluded:
        allowed[satellite_number(name)] = False
    return allowed


@lru_cache(maxsize=64)
def _setup(options: SinglePointOptions) -> Vector:
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
