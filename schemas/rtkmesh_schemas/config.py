"""The deployment file: one TOML, one table per process. Angles in degrees: this is the human edge.

Unknown fields are errors; every number has bounds. Loading with line numbers and nearest names is the shell's
(``rtkmesh_services.runtime.configuration``).
"""

from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from rtkmesh_schemas.config_attitude import AttitudeTable
from rtkmesh_schemas.config_base import NotNegative, Positive, Systems, Table
from rtkmesh_schemas.config_flockwave import FlockwaveTable
from rtkmesh_schemas.config_output import OutputTable
from rtkmesh_schemas.config_presets import BasesTable, FilterTable, PresetNames, PresetTable
from rtkmesh_schemas.config_rules import RuleTable
from rtkmesh_schemas.config_telnet import TelnetTable

LEAST_AMBIGUITIES: Final = 5  # of a baseline of unknown length, as the engine has it
Degrees90 = Annotated[float, Meta(ge=0.0, le=90.0)]
EcefVector = tuple[
    Annotated[float, Meta(ge=-1e7, le=1e7)], Annotated[float, Meta(ge=-1e7, le=1e7)], Annotated[float, Meta(ge=-1e7, le=1e7)]
]
GeodeticVector = tuple[
    Annotated[float, Meta(ge=-90.0, le=90.0)], Annotated[float, Meta(ge=-360.0, le=360.0)], Annotated[float, Meta(ge=-12000.0, le=100000.0)]
]
AntennaName = Annotated[str, Meta(max_length=40)]
ModeName = Literal["single", "dgps", "static", "static-start", "kinematic", "moving-base", "fixed"]
LogLevel = Literal["debug", "info", "warning", "error"]


class DeploymentTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[deployment]``: names and network of this host. ``namespace`` is the site or vehicle prefix of all keys."""

    name: str = "rtkmesh"
    namespace: str = ""
    connect: tuple[str, ...] = ()
    log_level: LogLevel = "info"
    config_folder: str = ""


class HubTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[hub]``: the Zenoh router of this host. Loopback only unless ``insecure`` is said (user and TLS come with the security profile)."""

    enabled: bool = True
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7547",)
    connect: tuple[str, ...] = ()
    insecure: bool = False


class CommandsTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[ingest.ID.commands]``: what the receiver of the first source is told: when it is there, when we leave, again and again.

    Lines as in RTKLIB's command files: text, ``!UBX CFG-RATE 200 1 1``, ``!HEX B5 62 ...``, ``!WAIT 100``, ``!BRATE 460800``; periodic ones
    end in ``# milliseconds``. ``file``: such a file, relative to the folder of configurations.
    """

    file: str = ""
    start: tuple[str, ...] = ()
    stop: tuple[str, ...] = ()
    periodic: tuple[str, ...] = ()


MessageNumbers = Annotated[tuple[Annotated[int, Meta(ge=1, le=4095)], ...], Meta(max_length=200)]
IdName = Annotated[str, Meta(min_length=1, max_length=64)]


class CorrectionsTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[ingest.ID.corrections]``: what the receiver of the first source gets of the RTCM 3 of bases.

    ``from``: ids of ingests; the first one that speaks is used, a later one when those before it are silent for ``fallback_after_s``.
    ``set`` basic: observations and the station's place (1001 to 1006, 1009 to 1012, MSM, 1230); full: all. ``accept`` names the
    messages instead, ``reject`` goes before both. ``link_bytes_per_s`` is what the link carries; of a serial port it is known, 0: no limit.
    """

    bases: tuple[IdName, ...] = msgspec.field(name="from")
    accept: MessageNumbers = ()
    reject: MessageNumbers = ()
    set: Literal["basic", "full"] = "basic"
    link_bytes_per_s: Annotated[float, Meta(ge=0.0, le=1e9)] | None = None
    fallback_after_s: Annotated[float, Meta(ge=1.0, le=3600.0)] = 10.0


class BaseStationTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[ingest.ID.base_station]``: where the antenna of this receiver stands, and who finds it out.

    ``mode``: ``survey-in``: the receiver averages its position for at least ``minimum_s`` until it is good to ``accuracy_m``; ``fixed``:
    it is told ``position_ecef_m`` or ``position_llh_deg`` (ellipsoidal height), good to ``accuracy_m``; ``preset``: it is told the saved
    position ``preset``, and surveys it first where none is saved; ``average``: we average its fixes, it is told nothing; ``watch``: it is
    told nothing, its 1005/1006 are watched. ``receiver`` is the language that it speaks. A position that is further than
    ``moved_limit_m`` from where the station stood is an error.
    """

    mode: Literal["survey-in", "fixed", "average", "preset", "watch"]
    receiver: Literal["ublox", "ublox-legacy", "unicore", "septentrio", "other"] = "other"
    minimum_s: Annotated[float, Meta(ge=1.0, le=86400.0)] = 60.0
    accuracy_m: Annotated[float, Meta(ge=0.001, le=100.0)] = 1.0
    position_ecef_m: EcefVector | None = None
    position_llh_deg: GeodeticVector | None = None
    preset: Annotated[str, Meta(pattern="^[A-Za-z0-9_.-]{0,64}$")] = ""
    datum: Annotated[str, Meta(max_length=64)] = ""
    moved_limit_m: Annotated[float, Meta(ge=0.001, le=1e5)] = 0.1
    check_s: Annotated[float, Meta(ge=1.0, le=3600.0)] = 10.0


class IngestTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[ingest.ID]``: one receiver. ``source`` is a URL: serial:, tcp:, tcp-listen:, udp:, ntrip:, ntrips:, file:, stdin:, sim:, ingest:.

    ``fallback`` are sources that are used, in their order, while those before them have given nothing for ``fallback_after_s``; one
    that is better placed is taken again when it has been back for ``return_after_s``.

    ``position_ecef_m`` or ``position_llh_deg`` (lat, lon, ellipsoidal height) is the antenna's known position and replaces what the
    stream says. ``date`` (YYYY-MM-DD) settles the week of RTCM logs. ``options`` are RTKLIB's receiver options (``"-TADJ=0.1 -GL2L"``).
    ``navigation`` marks a source of ephemerides only. ``filter`` says which frames are used.
    """

    source: str
    fallback: Annotated[tuple[str, ...], Meta(max_length=8)] = ()
    fallback_after_s: Annotated[float, Meta(ge=1.0, le=3600.0)] = 15.0
    return_after_s: Annotated[float, Meta(ge=1.0, le=86400.0)] = 120.0
    position_ecef_m: EcefVector | None = None
    position_llh_deg: GeodeticVector | None = None
    date: str = ""
    observations: Literal["auto", "ubx", "rtcm3", "unicore", "novatel", "sbf"] = "auto"
    options: str = ""
    navigation: bool = False
    raw: bool = True
    filter: FilterTable = FilterTable()
    commands: CommandsTable = CommandsTable()
    corrections: CorrectionsTable | None = None
    base_station: BaseStationTable | None = None

    @property
    def replay(self) -> bool:
        """Whether the source is a recording: deadlines run on the log's clock, consumers pace it."""
        return self.source.startswith("file://")

    @property
    def follows(self) -> tuple[str, ...]:
        """The ingests whose frames are sources of this one."""
        sources = (source for source in (self.source, *self.fallback) if source.startswith("ingest://"))
        return tuple(source.removeprefix("ingest://").partition("?")[0] for source in sources)


class NoiseTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[solver.ID.noise]``: one sigma; see the engine's NoiseOptions."""

    phase_a_m: Positive | None = None
    phase_b_m: NotNegative | None = None
    code_ratio: Positive | None = None


class DynamicsTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[solver.ID.dynamics]``: process noise."""

    acceleration_horizontal_mps2: Positive | None = None
    acceleration_vertical_mps2: Positive | None = None
    ambiguity_cyc: NotNegative | None = None


class AmbiguityTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[solver.ID.ambiguity]``: integer resolution. ``failure_rate``: fixes more probably wrong are floats."""

    mode: Literal["off", "instantaneous", "continuous", "fix-and-hold"] | None = None
    ratio: Annotated[float, Meta(ge=1.0, le=1000.0)] | None = None
    elevation_mask_deg: Degrees90 | None = None
    minimum_lock_epochs: Annotated[int, Meta(ge=0, le=10000)] | None = None
    minimum_ambiguities: Annotated[int, Meta(ge=3, le=64)] | None = None
    hold_after_epochs: Annotated[int, Meta(ge=1, le=100000)] | None = None
    failure_rate: Annotated[float, Meta(gt=0.0, le=1.0)] | None = None


class IntegrityTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[solver.ID.integrity]``: protection levels. ``risk`` per epoch of being off by more than them; larger ones than the alert limits
    are ``unavailable``.
    """

    enabled: bool | None = None
    risk: Annotated[float, Meta(ge=1e-12, le=0.1)] | None = None
    alert_horizontal_m: Positive | None = None
    alert_vertical_m: Positive | None = None


class SyncTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[solver.ID.sync]``: pairing. ``max_wait_s``: how long a rover epoch waits for its base epoch; ``matched_only``: pos2-syncsol.

    ``interpolate`` (recordings alone): where no base epoch matches, those on both sides are interpolated (misc-timeinterp); where nothing
    is said, ``rtkmesh solve`` does so and a solver of a deployment does not.
    """

    max_wait_s: Annotated[float, Meta(ge=0.0, le=60.0)] = 1.0
    matched_only: bool = False
    tolerance_s: Annotated[float, Meta(gt=0.0, le=0.5)] = 0.025
    interpolate: bool | None = None


class SolverTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[solver.ID]``: one solver instance. ``rover``, ``base`` and ``navigation`` are ids of ingests.

    ``rover_antenna`` and ``base_antenna`` are IGS names (``LEIAR25.R3 LEIT``) instead of what the streams say; ``antex`` is a file with
    calibrations that go before the shipped ones, relative to the folder of configurations.
    ``presets`` are base stations to choose from, the best first: control takes the next one when one is silent or bad.
    """

    rover: str
    base: str = ""
    presets: PresetNames = ()
    navigation: tuple[str, ...] = ()
    mode: ModeName = "kinematic"
    systems: Systems = "GREJC"
    frequencies: Annotated[int, Meta(ge=1, le=5)] = 2
    elevation_mask_deg: Degrees90 = 15.0
    cn0_mask_dbhz: Annotated[float, Meta(ge=0.0, le=60.0)] = 0.0
    max_age_s: Annotated[float, Meta(gt=0.0, le=3600.0)] = 30.0
    baseline_length_m: Positive | None = None
    baseline_sigma_m: Positive = 0.01
    fixed_position_ecef_m: EcefVector | None = None
    excluded: tuple[str, ...] = ()
    rover_antenna: AntennaName = ""
    base_antenna: AntennaName = ""
    antex: str = ""
    autostart: bool = True
    sync: SyncTable = SyncTable()
    noise: NoiseTable = NoiseTable()
    dynamics: DynamicsTable = DynamicsTable()
    ambiguity: AmbiguityTable = AmbiguityTable()
    integrity: IntegrityTable = IntegrityTable()


class RecorderTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[recorder.ID]``: raw logs of receivers with receive times, append-only, one new file per start, and every ``swap_hours``.

    ``folder`` may have RTKLIB's keywords (%Y%m%d/%h ...). ``tags``: RTKLIB's .tag beside each log as well.
    """

    folder: str
    receivers: tuple[str, ...] = ()
    swap_hours: NotNegative = 0.0
    tags: bool = False


class Ros2Table(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[ros2.ID]``: the bridge. Empty lists: everything there is.

    ``poses``: of an attitude (its id) the point of its ``points`` where ``base_frame_id`` is: its pose in the map, and its motion.
    ``map_origin``: latitude and longitude (deg) and ellipsoidal height (m) of the map's origin; without it the first position bridged.
    """

    solvers: tuple[str, ...] = ()
    attitudes: tuple[str, ...] = ()
    frame_id: str = "gnss_antenna"
    map_frame_id: str = "map"
    base_frame_id: str = "base_link"
    python: str = ""
    poses: dict[str, str] = {}
    map_origin: (
        tuple[
            Annotated[float, Meta(ge=-90.0, le=90.0)], Annotated[float, Meta(ge=-180.0, le=360.0)], Annotated[float, Meta(ge=-1e4, le=1e5)]
        ]
        | None
    ) = None


class MonitorTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[monitor.ID]``: the fleet's health as one status: stale streams, dead processes."""

    period_s: Annotated[float, Meta(gt=0.05, le=60.0)] = 1.0


class ControlTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[control]``: supervision of this host's processes."""

    enabled: bool = True
    heartbeat_timeout_s: Annotated[float, Meta(ge=1.0, le=600.0)] = 5.0
    term_grace_s: Annotated[float, Meta(ge=0.1, le=60.0)] = 2.0
    backoff_first_s: Annotated[float, Meta(ge=0.01, le=60.0)] = 0.2
    backoff_last_s: Annotated[float, Meta(ge=0.1, le=600.0)] = 5.0
    crash_limit: Annotated[int, Meta(ge=1, le=1000)] = 5
    crash_window_s: Annotated[float, Meta(ge=1.0, le=86400.0)] = 60.0


class Deployment(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole file."""

    deployment: DeploymentTable = DeploymentTable()
    hub: HubTable = HubTable()
    control: ControlTable = ControlTable()
    flockwave: FlockwaveTable = FlockwaveTable()
    ingest: dict[str, IngestTable] = {}
    solver: dict[str, SolverTable] = {}
    attitude: dict[str, AttitudeTable] = {}
    output: dict[str, OutputTable] = {}
    recorder: dict[str, RecorderTable] = {}
    ros2: dict[str, Ros2Table] = {}
    monitor: dict[str, MonitorTable] = {}
    bases: BasesTable = BasesTable()
    preset: dict[str, PresetTable] = {}
    telnet: dict[str, TelnetTable] = {}
    rule: dict[str, RuleTable] = {}
