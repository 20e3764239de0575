"""Engine solutions to the wire, and back for formats that need the engine's form."""

from math import degrees, isfinite, nan
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.frames import geodetic_from_ecef
from rtkmesh.gnss.signals import satellite_id, signal_code
from rtkmesh.models.atmosphere import zenith_hydrostatic_m, zenith_wet_m
from rtkmesh.rtk.local import in_enu
from rtkmesh.rtk.solution import Solution
from rtkmesh_schemas.solution import Matrix, SatellitesMessage, SolutionMessage, Vector

Array = NDArray[np.float64]

_NO_VECTOR: Final = (nan, nan, nan)
_NO_MATRIX: Final = (nan,) * 9
_NOT_SAID: Final[dict[str, Any]] = {  # by lines of positions
    **dict.fromkeys(("source", "start_id", "status_name", "reason"), ""),
    **dict.fromkeys(("sequence", "grade", "ambiguities", "ambiguities_fixed", "satellites_rover", "satellites_base", "resets"), 0),
    **dict.fromkeys(("lat_deg", "lon_deg", "height_m", "ratio_threshold", "success_rate", "code_rms_m", "phase_rms_m"), nan),
    **dict.fromkeys(("nis_per_observation", "receiver_clock_s"), nan),
    **dict.fromkeys(("velocity_enu_mps", "baseline_enu_m"), _NO_VECTOR),
    **dict.fromkeys(("position_cov_enu_m2", "velocity_cov_enu_m2ps2", "baseline_cov_enu_m2"), _NO_MATRIX),
}


def solution_message(solution: Solution, **identity: Any) -> SolutionMessage:
    """Return a solution as the wire's struct; ``identity`` gives source, start_id, sequence, mode, rover, base and clocks."""
    known = bool(np.isfinite(solution.position_ecef_m).all())
    lat_rad, lon_rad, height_m = geodetic_from_ecef(solution.position_ecef_m) if known else (nan, nan, nan)
    local = in_enu(solution)
    return SolutionMessage(
        week=solution.time.week,
        tow_s=solution.time.tow_s,
        status=int(solution.status),
        status_name=solution.status.name,
        reason=solution.reason.name.lower(),
        lat_deg=degrees(lat_rad),
        lon_deg=degrees(lon_rad),
        height_m=float(height_m),
        position_ecef_m=_vector(solution.position_ecef_m),
        position_cov_ecef_m2=_matrix(solution.position_cov_ecef_m2),
        position_cov_enu_m2=_matrix(local.position_cov_m2),
        velocity_ecef_mps=_vector(solution.velocity_ecef_mps),
        velocity_cov_ecef_m2ps2=_matrix(solution.velocity_cov_ecef_m2ps2),
        velocity_enu_mps=_vector(local.velocity_mps),
        velocity_cov_enu_m2ps2=_matrix(local.velocity_cov_m2ps2),
        base_ecef_m=_vector(solution.base_ecef_m),
        baseline_ecef_m=_vector(solution.baseline_ecef_m),
        baseline_enu_m=_vector(local.baseline_m),
        baseline_cov_enu_m2=_matrix(local.baseline_cov_m2),
        baseline_cov_ecef_m2=_matrix(solution.baseline_cov_ecef_m2),
        acceleration_ecef_mps2=_vector(solution.acceleration_ecef_mps2),
        acceleration_cov_ecef_m2ps4=_matrix(solution.acceleration_cov_ecef_m2ps4),
        acceleration_enu_mps2=_vector(local.acceleration_mps2),
        acceleration_cov_enu_m2ps4=_matrix(local.acceleration_cov_m2ps4),
        age_s=float(solution.age_s),
        ratio=float(solution.ratio),
        ratio_threshold=float(solution.ratio_threshold),
        success_rate=float(solution.success_rate),
        grade=int(solution.grade),
        ambiguities=int(solution.ambiguities),
        ambiguities_fixed=int(solution.ambiguities_fixed),
        satellites_used=int(solution.satellites_used),
        satellites_rover=int(solution.satellites_rover),
        satellites_base=int(solution.satellites_base),
        code_rms_m=float(solution.code_rms_m),
        phase_rms_m=float(solution.phase_rms_m),
        nis_per_observation=float(solution.nis_per_observation),
        receiver_clock_s=float(solution.receiver_clock_s),
        clocks_s=tuple(solution.clocks_s.tolist()),
        float_position_ecef_m=_vector(solution.float_state.position_ecef_m),
        float_velocity_ecef_mps=_vector(solution.float_state.velocity_ecef_mps),
        float_acceleration_ecef_mps2=_vector(solution.float_state.acceleration_ecef_mps2),
        zenith_delays_m=_zenith_delays_m(solution),
        glonass_slope_m=solution.glonass_slopes_m[0],
        glonass_slopes_m=solution.glonass_slopes_m,
        resets=int(solution.resets),
        waited_s=float(solution.waited_s),
        fix_probability=float(solution.fix_probability),
        protection_horizontal_m=float(solution.protection_horizontal_m),
        protection_vertical_m=float(solution.protection_vertical_m),
        integrity=solution.integrity.value,
        integrity_reason=solution.integrity_reason.name.lower(),
        **identity,
    )


def position_message(solution: Solution) -> SolutionMessage:
    """Return what lines of positions say of a solution (``texts.lines``) as the wire's struct; all else in it is not known.

    A quarter of the time of ``solution_message``.
    """
    return SolutionMessage(
        **_NOT_SAID,
        week=solution.time.week,
        tow_s=solution.time.tow_s,
        status=int(solution.status),
        position_ecef_m=_vector(solution.position_ecef_m),
        position_cov_ecef_m2=_matrix(solution.position_cov_ecef_m2),
        velocity_ecef_mps=_vector(solution.velocity_ecef_mps),
        velocity_cov_ecef_m2ps2=_matrix(solution.velocity_cov_ecef_m2ps2),
        base_ecef_m=_vector(solution.base_ecef_m),
        baseline_ecef_m=_vector(solution.baseline_ecef_m),
        baseline_cov_ecef_m2=_matrix(solution.baseline_cov_ecef_m2),
        age_s=float(solution.age_s),
        ratio=float(solution.ratio),
        satellites_used=int(solution.satellites_used),
    )


def satellites_message(solution: Solution, source: str) -> SatellitesMessage:
    """Return the satellite table of a solution as the wire's struct."""
    table = solution.satellites
    return SatellitesMessage(
        source=source,
        week=solution.time.week,
        tow_s=solution.time.tow_s,
        satellite=[satellite_id(number) for number in table.satellite.tolist()],
        signal=[signal_code(number) for number in table.signal.tolist()],
        state=table.state.tolist(),
        azimuth_deg=np.degrees(table.azimuth_rad).tolist(),
        elevation_deg=np.degrees(table.elevation_rad).tolist(),
        cn0_dbhz=table.cn0_dbhz.tolist(),
        code_residual_m=table.code_residual_m.tolist(),
        phase_residual_m=table.phase_residual_m.tolist(),
        ambiguity_cyc=table.ambiguity_cyc.tolist(),
        lock_s=table.lock_s.tolist(),
        slips=table.slips.tolist(),
        ambiguity_variance_cyc2=table.ambiguity_variance_cyc2.tolist(),
        lock_epochs=table.lock_epochs.tolist(),
        rejects=table.rejects.tolist(),
        ionosphere_m=_ionosphere_m(solution),
    )


def _ionosphere_m(solution: Solution) -> list[float]:
    """Return the ionosphere's delay of each row of the satellite table."""
    state = solution.float_state
    delays = dict(zip(state.satellites.tolist(), state.ionosphere_m.tolist(), strict=True))
    return [delays.get(number, nan) for number in solution.satellites.satellite.tolist()]


def _zenith_delays_m(solution: Solution) -> tuple[float, float]:
    """Return the zenith delays of rover and base (the base's is the model's), NaN where the filter has no such state."""
    relative_m = float(solution.float_state.zenith_m)
    if not isfinite(relative_m):
        return nan, nan
    rover_m, base_m = (model_zenith_m(place) for place in (solution.position_ecef_m, solution.base_ecef_m))
    return rover_m + relative_m, base_m


def model_zenith_m(position_ecef_m: Array) -> float:
    """Return the zenith delay (m) of the model atmosphere at a place: what estimated delays are added to."""
    lat_rad, _, height_m = geodetic_from_ecef(position_ecef_m).tolist()
    return float(zenith_hydrostatic_m(lat_rad, height_m) + zenith_wet_m(height_m))


def _vector(values: Array) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


def _matrix(values: Array) -> Matrix:
    return tuple(values.ravel().tolist())
