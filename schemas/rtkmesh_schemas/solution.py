"""What a solver publishes."""

from rtkmesh_schemas.wire import Wire

Vector = tuple[float, float, float]
Matrix = tuple[float, ...]  # 9 numbers, row-major 3x3


class SolutionMessage(Wire, frozen=True, kw_only=True):
    """One epoch's solution. NaN is 'not known'. Covariances are full 3x3, row-major.

    ``status``: 0 none, 1 fix, 2 float, 4 dgps, 5 single (RTKLIB's Q); ``status_name`` the same in words; ``reason`` says why
    not better. ``age_s``: rover minus base epoch; ``waited_s``: from the epoch's arrival to its solving; ``solve_ms``: compute.
    ``baseline`` is rover minus base. Heights are ellipsoidal. ``received_mono_ns``/``published_mono_ns``: this host's clock.
    ``velocity``: of the rover's antenna (of a moving base too), at the epoch's instant, from phases and Dopplers; ``float_velocity`` is
    the filter's (of a moving base: of the baseline), as ``acceleration`` is.

    ``fix_probability``: that the integers of a fix are right, 0 without a fix. Protection levels are exceeded with the configured risk
    per epoch under stated assumptions (infinite: nothing bounds the error). ``integrity``: ok, failed, unavailable, with
    ``integrity_reason``. No certified integrity: docs/concepts/integrity.md.

    ``clocks_s``: receiver clock minus the system's time, by system in the order GRECJSI. ``float_*``: the solution without integers.
    ``zenith_delays_m``: of rover and base, where they are estimated; ``glonass_slopes_m``: what phases on G1 and on G2
    are off per frequency channel, by the held integers; ``glonass_slope_m``: that on G1.
    ``candidates``: the candidate integers of this epoch follow on their own key.
    """

    source: str
    start_id: str
    sequence: int
    week: int
    tow_s: float
    status: int
    status_name: str
    reason: str
    lat_deg: float
    lon_deg: float
    height_m: float
    position_ecef_m: Vector
    position_cov_ecef_m2: Matrix
    position_cov_enu_m2: Matrix
    velocity_ecef_mps: Vector
    velocity_cov_ecef_m2ps2: Matrix
    velocity_enu_mps: Vector
    velocity_cov_enu_m2ps2: Matrix
    base_ecef_m: Vector
    baseline_ecef_m: Vector
    baseline_enu_m: Vector
    baseline_cov_enu_m2: Matrix
    age_s: float
    ratio: float
    ratio_threshold: float
    success_rate: float
    grade: int
    ambiguities: int
    ambiguities_fixed: int
    satellites_used: int
    satellites_rover: int
    satellites_base: int
    code_rms_m: float
    phase_rms_m: float
    nis_per_observation: float
    receiver_clock_s: float
    resets: int
    mode: str = ""
    rover: str = ""
    base: str = ""
    acceleration_ecef_mps2: Vector = (float("nan"), float("nan"), float("nan"))
    waited_s: float = 0.0
    solve_ms: float = 0.0
    received_mono_ns: int = 0
    published_mono_ns: int = 0
    acceleration_cov_ecef_m2ps4: Matrix = (float("nan"),) * 9
    acceleration_enu_mps2: Vector = (float("nan"), float("nan"), float("nan"))
    acceleration_cov_enu_m2ps4: Matrix = (float("nan"),) * 9
    fix_probability: float = 0.0
    protection_horizontal_m: float = float("nan")
    protection_vertical_m: float = float("nan")
    integrity: str = "unavailable"
    integrity_reason: str = ""
    baseline_cov_ecef_m2: Matrix = (float("nan"),) * 9
    clocks_s: tuple[float, ...] = (float("nan"),) * 7
    float_position_ecef_m: Vector = (float("nan"), float("nan"), float("nan"))
    float_velocity_ecef_mps: Vector = (float("nan"), float("nan"), float("nan"))
    float_acceleration_ecef_mps2: Vector = (float("nan"), float("nan"), float("nan"))
    zenith_delays_m: tuple[float, float] = (float("nan"), float("nan"))
    glonass_slope_m: float = float("nan")
    base_station_id: int = 0
    candidates: bool = False
    glonass_slopes_m: tuple[float, float] = (float("nan"), float("nan"))


class SatellitesMessage(Wire, frozen=True, kw_only=True):
    """Per satellite and signal of the newest epoch.

    ``state`` bits: 1 code used, 2 phase used, 4 fixed, 8 slipped, 16 rejected, 32 half cycle. ``lock_epochs``: epochs since the ambiguity
    began; ``rejects``: epochs in a row in which the phase did not fit; ``ionosphere_m``: delay on L1 along the ray, rover against base and
    beyond the model, NaN where it is not estimated.
    """

    source: str
    week: int
    tow_s: float
    satellite: list[str]
    signal: list[str]
    state: list[int]
    azimuth_deg: list[float]
    elevation_deg: list[float]
    cn0_dbhz: list[float]
    code_residual_m: list[float]
    phase_residual_m: list[float]
    ambiguity_cyc: list[float]
    lock_s: list[float]
    slips: list[int]
    ambiguity_variance_cyc2: list[float] = []
    lock_epochs: list[int] = []
    rejects: list[int] = []
    ionosphere_m: list[float] = []
