"""How a base station's position is found, as its status says it."""

from rtkmesh_schemas.base import SurveyStatus
from rtkmesh_services.ingest.base.found import Found
from rtkmesh_services.ingest.base.station import BaseStation


def survey_status(station: BaseStation, now_s: float) -> SurveyStatus:
    """Return the status of a base station."""
    found, moved = station.found, station.watch.moved
    known = _known(station, now_s)
    return SurveyStatus(
        mode=station.table.mode,
        state=station.state,
        supported=station.dialect is not None or station.table.mode == "average",
        active=station.state in ("surveying", "averaging"),
        valid=found is not None and moved is None,
        duration_s=known.duration_s if known else 0.0,
        minimum_s=station.minimum_s,
        observations=known.observations if known else 0,
        accuracy_m=known.accuracy_m if known and known.accuracy_m > 0.0 else None,
        accuracy_goal_m=station.accuracy_m,
        position_ecef_m=known.position_ecef_m if known and any(known.position_ecef_m) else None,
        source=found.source if found else "",
        preset=station.name,
        moved_m=None if moved is None else moved.distance_m,
        moved_enu_m=None if moved is None else moved.enu_m,
        failure=station.failure,
    )


def _known(station: BaseStation, now_s: float) -> Found | None:
    """Return the position as far as it is known: found, or on the way (without a position yet: zeros)."""
    progress, mean = station.progress, station.mean
    if station.found is not None:
        return station.found
    if station.state == "surveying" and progress is not None:
        position = progress.position_ecef_m or (0.0, 0.0, 0.0)
        return Found(position, progress.accuracy_m, "", progress.duration_s, progress.observations)
    if station.state == "surveying":
        return Found((0.0, 0.0, 0.0), 0.0, "", max(0.0, now_s - station.begun_s))
    if mean is not None:
        return Found(mean.position_ecef_m, mean.accuracy_m, "", mean.duration_s, mean.observations)
    return None
