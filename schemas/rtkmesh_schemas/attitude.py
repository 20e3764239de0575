"""What an attitude process publishes."""

from rtkmesh_schemas.wire import Wire


class AttitudeMessage(Wire, frozen=True, kw_only=True):
    """Attitude of the vehicle at one epoch. Angles in radians, covariance of (heading, pitch, roll), row-major 3x3, rad^2.

    ``heading_rad``: navigation azimuth, clockwise from true north, [0, 2 pi); ``yaw_enu_rad``: REP-103, anticlockwise from
    east; ``pitch_rad``: nose up positive; ``roll_rad``: NaN with two antennas. ``integrity``: ok, failed, unavailable, with
    ``reason``. ``length_error_m``: measured minus configured baseline length, NaN without one.
    """

    source: str
    start_id: str
    sequence: int
    week: int
    tow_s: float
    status: int
    status_name: str
    integrity: str
    reason: str
    heading_rad: float
    pitch_rad: float
    roll_rad: float
    yaw_enu_rad: float
    covariance_rad2: tuple[float, ...]
    baseline_length_m: float
    length_error_m: float
    antennas: list[str]
    age_s: float = 0.0
    received_mono_ns: int = 0
    published_mono_ns: int = 0
