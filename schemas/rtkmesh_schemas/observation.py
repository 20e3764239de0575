"""What a receiver's ingest publishes: epochs, ephemerides, reference station, end of stream; and what paces it."""

from typing import Final

from rtkmesh_schemas.wire import Wire

Time = tuple[int, float]  # GPS week, seconds of week
Vector = tuple[float, float, float]


class Observation(Wire, frozen=True, kw_only=True):
    """One epoch: one row per satellite and signal. Columns are little-endian bytes: f8 where not said otherwise.

    ``sequence`` counts all messages of this ingest's stream (observations, ephemerides, reference, end) since ``start_id``.
    Satellites are RINEX ids, signals RINEX codes. NaN is 'not observed'. ``channel`` (i1) is the GLONASS frequency number,
    127 unknown; ``flags`` (u1): 1 slip, 2 half cycle not resolved. ``received_mono_ns`` is the host's monotonic clock when
    the epoch's last byte was read.
    """

    source: str
    start_id: str
    sequence: int
    week: int
    tow_s: float
    satellite: list[str]
    signal: list[str]
    channel: bytes
    flags: bytes
    pseudorange_m: bytes
    phase_cyc: bytes
    doppler_hz: bytes
    cn0_dbhz: bytes
    lock_s: bytes
    pseudorange_sigma_m: bytes
    phase_sigma_cyc: bytes
    received_mono_ns: int = 0
    received_utc_ns: int = 0
    published_mono_ns: int = 0


class KeplerOrbit(Wire, tag="kepler", frozen=True, kw_only=True):
    """Keplerian broadcast ephemeris; fields as in ``rtkmesh.gnss.ephemeris.KeplerEphemeris``; times are GPST."""

    satellite: str
    message: int
    iode: int
    iodc: int
    toe: Time
    toc: Time
    transmitted: Time
    health: int
    accuracy_m: float
    fit_s: float
    sqrt_a: float
    eccentricity: float
    m0_rad: float
    delta_n_radps: float
    omega0_rad: float
    omega_rad: float
    omega_dot_radps: float
    i0_rad: float
    idot_radps: float
    cuc_rad: float
    cus_rad: float
    crc_m: float
    crs_m: float
    cic_rad: float
    cis_rad: float
    af0_s: float
    af1: float
    af2: float
    group_delay_s: tuple[float, float]


class GlonassState(Wire, tag="glonass", frozen=True, kw_only=True):
    """GLONASS broadcast ephemeris; fields as in ``rtkmesh.gnss.ephemeris.GlonassEphemeris``; times are GPST."""

    satellite: str
    channel: int
    iode: int
    toe: Time
    transmitted: Time
    health: int
    accuracy_m: float
    age_days: int
    position_m: Vector
    velocity_mps: Vector
    acceleration_mps2: Vector
    tau_s: float
    gamma: float
    group_delay_s: float


class EphemerisMessage(Wire, frozen=True, kw_only=True):
    """An ephemeris as it came in its stream. It counts for epochs that follow it.

    ``after`` is the time of the newest epoch that preceded it in its own stream (None: before the first one).
    """

    source: str
    start_id: str
    sequence: int
    orbit: KeplerOrbit | GlonassState
    after: Time | None = None


class IonosphereMessage(Wire, frozen=True, kw_only=True):
    """Klobuchar coefficients sent by the system of RINEX letter ``system``."""

    source: str
    start_id: str
    sequence: int
    system: str
    alpha: tuple[float, float, float, float]
    beta: tuple[float, float, float, float]
    after: Time | None = None


class ReferenceMessage(Wire, frozen=True, kw_only=True):
    """The receiver's antenna: position (ECEF, m) and where it came from, antenna, receiver, GLONASS code-phase biases (m)."""

    source: str
    start_id: str
    sequence: int
    station_id: int
    position_ecef_m: Vector | None = None
    antenna_height_m: float = 0.0
    antenna: str = ""
    antenna_serial: str = ""
    receiver: str = ""
    datum: str = ""
    origin: str = ""
    glonass_bias_m: tuple[float, float, float, float] | None = None
    after: Time | None = None


class EndOfStream(Wire, frozen=True, kw_only=True):
    """A replayed source is at its end."""

    source: str
    start_id: str
    sequence: int
    after: Time | None = None


CREDIT_WINDOW: Final = 32  # messages that a replay is ahead of its slowest consumer at most


class Credit(Wire, frozen=True, kw_only=True):
    """A consumer has taken everything of this ingest up to ``sequence`` (-1: ready for the first message).

    ``wanted``: the consumer needs the stream up to this time, however much it has not yet taken.
    """

    consumer: str
    consumer_start_id: str
    sequence: int
    ingest_start_id: str = ""
    wanted: Time | None = None
