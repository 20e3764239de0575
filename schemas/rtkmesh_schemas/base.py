"""Base stations: saved positions, and how a survey goes."""

from rtkmesh_schemas.observation import Vector
from rtkmesh_schemas.wire import Wire


class BasePosition(Wire, frozen=True, kw_only=True):
    """A saved position of a base station's antenna reference point (ECEF, m).

    ``accuracy_m`` is one sigma in three dimensions, as good as ``source`` knows it (survey-in, average, configuration, rtcm3, operator);
    ``datum`` is the frame in words, empty: that of the broadcast ephemerides (WGS 84); ``saved_utc`` is ISO 8601.
    """

    name: str
    position_ecef_m: Vector
    accuracy_m: float
    source: str
    saved_utc: str
    datum: str = ""
    duration_s: float = 0.0
    observations: int = 0
    antenna: str = ""
    antenna_height_m: float = 0.0
    receiver: str = ""
    saved_by: str = ""


class SurveyStatus(Wire, frozen=True, kw_only=True):
    """How a base station's position is found.

    ``state``: waiting, asking, checking, telling, surveying, averaging, fixed, surveyed, averaged, watching, off, failed.
    ``supported``: the receiver can survey (or we average for it); ``active``: it is being found; ``valid``: it is known.
    ``moved_m`` and ``moved_enu_m`` are how far and whereto the station is from where it stood, if that is too far.
    """

    mode: str
    state: str
    supported: bool = False
    active: bool = False
    valid: bool = False
    duration_s: float = 0.0
    minimum_s: float = 0.0
    observations: int = 0
    accuracy_m: float | None = None
    accuracy_goal_m: float = 0.0
    position_ecef_m: Vector | None = None
    source: str = ""
    preset: str = ""
    moved_m: float | None = None
    moved_enu_m: Vector | None = None
    failure: str = ""
