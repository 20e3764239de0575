"""What an attitude process publishes, and the headings that receivers compute, as their ingests publish them."""

from rtkmesh_schemas.wire import Wire

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

NAN = float("nan")
NAN3 = (NAN, NAN, NAN)
NAN4 = (NAN, NAN, NAN, NAN)
NAN9 = (NAN,) * 9


class BodyPoint(Wire, frozen=True, kw_only=True):
    """Where a point of the body is. NaN without a position of any antenna. Height above the ellipsoid; covariance ENU, row-major, m^2.

    Its velocity (ENU, m/s) with covariance: of the filtered attitude alone, which knows how the body turns about its antennas.
    """

    position_ecef_m: Vector = NAN3
    lat_deg: float = NAN
    lon_deg: float = NAN
    height_m: float = NAN
    cov_enu_m2: tuple[float, ...] = NAN9
    velocity_enu_mps: Vector = NAN3
    velocity_cov_enu_m2ps2: tuple[float, ...] = NAN9


class AttitudeMessage(Wire, frozen=True, kw_only=True):
    """Attitude of the vehicle at one epoch. Angles in radians, covariance of (heading, pitch, roll), row-major 3x3, rad^2.

    ``heading_rad``: navigation azimuth of the nose, clockwise from true north, [0, 2 pi); ``yaw_enu_rad``: REP-103, anticlockwise from
    east; ``pitch_rad``: nose up positive; ``roll_rad``: right side down positive. What antennas on one line do not see is NaN.
    ``integrity``: ok, failed, unavailable, with ``reason``. ``length_error_m``: measured minus configured baseline length of one
    baseline, NaN without one. NaN is "not known", never 0.

    ``finding`` of the test of the rigid body: ok, excluded, no redundancy, not identifiable, no attitude; ``chi_square`` with
    ``degrees`` of freedom. ``antennas_used``; ``antennas_excluded``: found at fault and left out; ``antennas_suspect``: one of these is
    at fault, which is not to be told. ``shape`` that the used ones span: point, line, plane, space. ``sources`` used with their kinds
    (baseline, position, heading; geometry: a baseline whose integers the known places of the antennas decided); ``sources_missing`` with
    the reason. Quaternions (w, x, y, z): ``ned_from_body`` of axes forward,
    right, down; ``enu_from_flu`` of axes forward, left, up (ROS); NaN without heading, an unseen angle is level in them, and
    ``rotation_cov_ned_rad2`` (of the small rotation in NED) says how uncertain. ``rate_radps``: forward, right, down, of the filter.
    ``points``: of the body. ``predicted_s``: since the last measurement, of the filter's. ``waited_ms``: from the arrival of the last
    message of the epoch at the process until the attitude is handed over, but for its encoding; ``resets`` of the filter. ``geometry``:
    what became of the choice of integers by the known places (accepted, or why not; empty: it was not needed) and the probability that
    what was accepted is wrong.

    ``protection_rad``: heading, pitch and roll are further off than these with the configured risk, by what docs/concepts/rigid-body.md
    assumes; infinite: nothing bounds the error; NaN: not seen, or not of an epoch (the filter's). ``protection_open``: antennas whose fault
    no other would show; where a level is finite all the same it is bounded by the satellites of their baseline.
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
    finding: str = ""
    chi_square: float = NAN
    degrees: int = 0
    antennas_used: list[str] = []
    antennas_excluded: list[str] = []
    antennas_suspect: list[str] = []
    shape: str = ""
    sources: dict[str, str] = {}
    sources_missing: dict[str, str] = {}
    quaternion_ned_from_body: Quaternion = NAN4
    quaternion_enu_from_flu: Quaternion = NAN4
    rotation_cov_ned_rad2: tuple[float, ...] = NAN9
    rate_radps: Vector = NAN3
    rate_cov_rad2ps2: tuple[float, ...] = NAN9
    points: dict[str, BodyPoint] = {}
    predicted_s: float = 0.0
    waited_ms: float = NAN
    resets: int = 0
    geometry: str = ""
    geometry_wrong_probability: float = NAN
    protection_rad: Vector = NAN3
    protection_open: list[str] = []


class HeadingMessage(Wire, frozen=True, kw_only=True):
    """A heading as a receiver computed it. NaN unless the receiver says that it is valid.

    ``heading_rad``: clockwise from true north, of the line of its antennas (``of_baseline``) or of the vehicle. ``time``: GPS week and
    seconds, None where it says none. ``message``: its name there. ``solution``: none, single, float, fixed as it says, or nothing.
    """

    source: str
    start_id: str
    sequence: int
    time: tuple[int, float] | None
    message: str
    valid: bool
    solution: str = ""
    of_baseline: bool = True
    heading_rad: float = NAN
    heading_sigma_rad: float = NAN
    pitch_rad: float = NAN
    pitch_sigma_rad: float = NAN
    roll_rad: float = NAN
    roll_sigma_rad: float = NAN
    length_m: float = NAN
    length_sigma_m: float = NAN
    satellites: int | None = None
    received_mono_ns: int = 0
