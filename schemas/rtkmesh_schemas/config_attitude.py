"""``[attitude.ID]`` of the deployment file: the antennas of a body, what tells of them, and what is made of it."""

from typing import Annotated, Literal

from msgspec import Meta

from rtkmesh_schemas.config_base import Positive, Table

Metres = Annotated[float, Meta(ge=-1000.0, le=1000.0)]
Place = tuple[Metres, Metres, Metres]
LARGEST_SIGMA_M = 10.0
Azimuth = Annotated[float, Meta(ge=-360.0, le=360.0)]
Elevation = Annotated[float, Meta(ge=-90.0, le=90.0)]
Ids = Annotated[tuple[Annotated[str, Meta(min_length=1, max_length=64)], ...], Meta(max_length=64)]


class AntennaPlaceTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[attitude.ID.antennas.NAME]``: where the antenna of ingest NAME is in the vehicle: forward, right, down from its origin, m.

    ``sigma_m``: how well that is known, one number or three. ``covariance_m2``: instead, as ``rtkmesh antennas calibrate`` writes it, the
    covariance (3x3, row-major) with itself and with antennas named before it; it counts between antennas that both have one.
    """

    position_m: Place
    sigma_m: float | tuple[float, float, float] = 0.0  # bounds are checked by the shell: msgspec 0.22 mixes those of a union up
    covariance_m2: dict[str, tuple[Metres, Metres, Metres, Metres, Metres, Metres, Metres, Metres, Metres]] = {}

    @property
    def sigmas_m(self) -> Place:
        """The three sigmas."""
        return self.sigma_m if isinstance(self.sigma_m, tuple) else (self.sigma_m, self.sigma_m, self.sigma_m)


class BodyPointTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[attitude.ID.points.NAME]``: a point of the vehicle (forward, right, down from its origin, m) whose position is published."""

    position_m: Place


class ReceiverHeadingTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[attitude.ID.headings.INGEST]``: a heading that the receiver of an ingest computes itself.

    ``antennas``: the two of ``[attitude.ID.antennas]`` that it is of, from and to: it is used while no solver gives that baseline. Else
    ``mounting_deg`` (clockwise from the nose) and ``mounting_pitch_deg`` say where its line of antennas points.
    ``sigma_deg``: of headings that say none themselves, and the least that is believed.
    """

    antennas: tuple[str, str] | None = None
    mounting_deg: Azimuth = 0.0
    mounting_pitch_deg: Elevation = 0.0
    sigma_deg: Annotated[float, Meta(ge=0.001, le=90.0)] = 0.2


class ImuTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[attitude.ID.imu]``: an IMU for the filter, from any program: JSON or msgpack maps on ``key``.

    Fields: ``rate_radps`` (3, body axes forward, right, down); ``force_mps2`` (3, the same axes; 0, 0, -9.81 at rest): the plumb line,
    less the vehicle's acceleration where ``positions`` tell it; ``yaw_increment_rad`` with ``interval_s``: by how much its own yaw grew
    (clockwise), for the filter of kind ``heading``. Any of them; with ``week`` and ``tow_s`` (GPS time) or ``utc_s`` (seconds since 1970).
    ``sigma_radps``: of one rate. ``force_sigma_mps2``: of half a second's mean force, its bias included. ``acceleration_sigma_mps2``:
    how much the vehicle accelerates where no position tells. ``yaw_increment_sigma_rad``: of one growth of yaw.
    """

    key: Annotated[str, Meta(min_length=1, max_length=200)]
    sigma_radps: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.005
    force_sigma_mps2: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.1
    acceleration_sigma_mps2: Annotated[float, Meta(gt=0.0, le=50.0)] = 0.7
    yaw_increment_sigma_rad: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.001


class CourseTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[attitude.ID.course]``: where the vehicle goes is where it points, for the filter. Off without this table: a vehicle that backs,
    drifts, crabs in wind or current, or is carried, goes elsewhere, and nothing in its velocity says so.

    ``position``: the one of ``positions`` whose velocity it is. ``min_speed_mps``: slower, there is none; ``sideslip_deg``: one sigma
    between where it points and where it goes; ``max_sigma_deg``: less sure than that, there is none. The antenna's lever arm about the
    origin of the body (which is to be where it does not slip: the rear axle) is taken into account.
    """

    position: Annotated[str, Meta(min_length=1, max_length=64)]
    min_speed_mps: Annotated[float, Meta(gt=0.0, le=100.0)] = 1.0
    sideslip_deg: Annotated[float, Meta(gt=0.0, le=90.0)] = 3.0
    max_sigma_deg: Annotated[float, Meta(gt=0.0, le=90.0)] = 10.0


class AttitudeFilterTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[attitude.ID.filter]``: the attitude goes on between and without epochs, on ``rtk/ID/att/filtered``, with turn rates.

    ``kind``: of the whole ``rotation``, or of the ``heading`` alone. ``publish``: at every epoch (``epochs``), or also at every sample
    of ``[attitude.ID.imu]`` (``gyro``). ``rate_walk_radps_rts``: how quickly the vehicle starts and stops to turn (rad/s per root
    second). ``correlation_s``: how long errors of epochs hang together. ``false_alarm``: probability of gating a good epoch.
    ``max_coast_s``: after so long without an epoch there is no attitude.
    """

    kind: Literal["rotation", "heading"] = "rotation"
    publish: Literal["epochs", "gyro"] = "epochs"
    rate_walk_radps_rts: Annotated[float, Meta(gt=0.0, le=100.0)] = 0.2
    correlation_s: Annotated[float, Meta(ge=0.0, le=3600.0)] = 0.0
    false_alarm: Annotated[float, Meta(ge=1e-9, le=0.1)] = 1e-4
    max_coast_s: Annotated[float, Meta(gt=0.0, le=3600.0)] = 10.0


class AttitudeIntegrityTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[attitude.ID.integrity]``: protection levels. ``risk``: probability per epoch that an angle is further off than its level.

    ``antenna_fault``: prior probability per epoch that what one antenna measures is off by more than its sigmas say, beside wrong integers,
    whose probability the solvers tell. An attitude with levels above ``alert_heading_deg`` or ``alert_tilt_deg`` (pitch and roll) is
    ``unavailable``. Levels of two antennas are those of their baseline: its solver's ``risk`` should be the same.
    """

    risk: Annotated[float, Meta(ge=1e-12, le=0.1)] = 1e-5
    antenna_fault: Annotated[float, Meta(ge=0.0, le=0.5)] = 1e-4
    alert_heading_deg: Annotated[float, Meta(gt=0.0, le=180.0)] | None = None
    alert_tilt_deg: Annotated[float, Meta(gt=0.0, le=180.0)] | None = None


class AttitudeTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[attitude.ID]``: heading, pitch and roll of a vehicle from its antennas.

    One baseline: ``solver`` (moving-base) with ``mounting_deg``, azimuth of the baseline (base to rover antenna) in the vehicle frame,
    clockwise from the nose (0: the rover antenna is ahead of the base antenna), ``mounting_pitch_deg`` and ``length_m``: known antenna
    distance; a fix further off than ``length_tolerance_m`` fails integrity.

    Any number of antennas: their places in ``[attitude.ID.antennas.NAME]``, or in a file ``layout`` (of ``rtkmesh antennas calibrate``,
    relative to the folder of configurations); and any mix of ``solvers`` (moving-base, between these antennas), ``positions``
    (kinematic solvers of these antennas) and ``[attitude.ID.headings.INGEST]``. ``wait_s``: how long an epoch waits for the last of
    them. ``rate``: attitudes at the epochs of the ``slowest`` of them, or at every epoch of the ``fastest`` with what it has.
    ``false_alarm``: probability per epoch to find a fault where there is none. ``unseen_tilt_deg``: one sigma of the tilt
    about antennas on one line, which they do not see. ``geometry``: known
    places (or ``length_m``) decide between the candidate integers of baselines that are not fixed, or contradict each other; on, because
    it costs a millisecond, gives single epochs of one frequency an attitude, and is wrong about as often as its failure rate of 1 % allows
    (benchmarks/attitude_search.py: with GPS on one frequency 0.4 to 1.6 % of those, else never).
    ``max_tilt_deg``: the vehicle is never further from level, which helps that choice.
    ``points``: places of the vehicle whose position is published.
    """

    solver: str = ""
    mounting_deg: Azimuth = 0.0
    mounting_pitch_deg: Elevation = 0.0
    length_m: Positive | None = None
    length_tolerance_m: Positive = 0.05
    accept_float: bool = False
    solvers: Ids = ()
    positions: Ids = ()
    headings: dict[str, ReceiverHeadingTable] = {}
    antennas: dict[str, AntennaPlaceTable] = {}
    layout: Annotated[str, Meta(max_length=200)] = ""
    points: dict[str, BodyPointTable] = {}
    rate: Literal["slowest", "fastest"] = "slowest"
    wait_s: Annotated[float, Meta(ge=0.001, le=10.0)] = 0.2
    false_alarm: Annotated[float, Meta(ge=1e-9, le=0.1)] = 1e-3
    unseen_tilt_deg: Annotated[float, Meta(ge=0.1, le=90.0)] = 10.0
    geometry: bool = True
    max_tilt_deg: Annotated[float, Meta(gt=0.0, le=180.0)] = 180.0
    integrity: AttitudeIntegrityTable = AttitudeIntegrityTable()
    imu: ImuTable | None = None
    filter: AttitudeFilterTable | None = None
    course: CourseTable | None = None

    @property
    def length_sigma_m(self) -> float:
        """One sigma of the known length: nothing right is outside its tolerance, which is five."""
        return self.length_tolerance_m / 5.0

    @property
    def sources(self) -> tuple[str, ...]:
        """The ids of all processes that it takes from."""
        own = (self.solver,) if self.solver else ()
        return (*own, *self.solvers, *self.positions, *self.headings)

    @property
    def takes_solutions_of(self) -> tuple[str, ...]:
        """The solvers among them."""
        return tuple(name for name in self.sources if name not in self.headings)
