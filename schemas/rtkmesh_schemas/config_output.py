"""``[output.ID]`` of the deployment file: what is sent, how it is written, and where it goes."""

from typing import Annotated, Final, Literal

from msgspec import Meta

from rtkmesh_schemas.config_base import NotNegative, Systems, Table

Interval = Annotated[float, Meta(ge=0.0, le=3600.0)]
NmeaInterval = Annotated[float, Meta(ge=-1.0, le=3600.0)]
POS_FORMATS: Final = ("llh", "xyz", "enu", "vel_enu")  # with a header, a time column and numbers in columns


class OutputTable(Table, frozen=True, kw_only=True, forbid_unknown_fields=True):
    r"""``[output.ID]``: one output stream. ``target`` is a URL: file:, serial:, tcp-listen:, tcp:, udp:, ntrip: and ntrips: (feed a mount
    point of a caster), ntrip-caster: (be one), ingest: (to the receiver of an ingest), stdout:, zenoh:.

    Either ``solver``: its solutions, in a ``format``; or ``receiver``: its whole frames as they came, of one ``protocol`` and, where
    ``messages`` names RTCM 3 message numbers, only those. With ``encode`` the receiver's ingest (of the same file) makes RTCM 3 of what it
    decodes, whatever the receiver sends: MSM of that type with the ``systems``, at multiples of ``interval_s`` (0: every epoch), thinned to
    ``bytes_per_second`` (0: no limit); 1006, 1008, 1033 and 1230 every ``station_interval_s``; ephemerides when they are new, and again
    every ``ephemeris_interval_s`` (0: not again). A caster has ``mounts`` (mount point = receiver) and ``users`` (name =
    password); ``anonymous`` lets everybody read who can reach it.

    A solver's output has RTKRCV's options (their names in brackets): epochs at multiples of ``interval_s`` (0: all); ``single``: also
    solutions without the base where there is one [out-outsingle]; ``max_sigma_m``: none whose largest standard deviation is above (0: all)
    [out-maxsolstd]. Of llh, xyz, enu and vel_enu: ``time_system`` [out-timesys], ``time_form`` [out-timeform], ``time_decimals``
    [out-timendec], ``separator``, ``\\t`` is a tab [out-fieldsep], ``header``: on, off (the line with the column names stays) or none
    [out-outhead], ``header_options`` [out-outopt]; of llh ``angles`` [out-degform] and ``height`` [out-height]; of llh and xyz ``velocity``
    columns [out-outvel]. ``dialect``: of demo5 and 2.4.3 (CR LF), or of 2.4.2 (LF); ``line_end`` overrules its line ends. Of nmea:
    ``nmea_rule``: what NMEA 0183 says, or what RTKLIB writes, ``talker``, ``nmea_interval_s`` of RMC, GGA and GST [out-nmeaintv1] and
    ``nmea_satellites_interval_s`` of GSA and GSV [out-nmeaintv2], 0: every epoch, -1: never. Of stat: ``status_level`` [out-outstat].

    What waits for a slow or absent taker is dropped, oldest first, when it is older than ``maximum_delay_s``.
    """

    target: str
    solver: str = ""
    format: Literal["llh", "xyz", "enu", "vel_enu", "nmea", "stat", "json"] = "llh"
    time_system: Literal["gpst", "utc", "jst"] = "gpst"
    time_form: Literal["hms", "tow"] = "hms"
    time_decimals: Annotated[int, Meta(ge=0, le=12)] = 3
    angles: Literal["deg", "dms"] = "deg"
    separator: Annotated[str, Meta(max_length=16, pattern=r"^[^\r\n%]*$")] = " "
    height: Literal["ellipsoidal", "geodetic"] = "ellipsoidal"
    geoid: Literal["internal"] = "internal"
    velocity: bool = False
    header: Literal["on", "off", "none"] = "on"
    header_options: bool = False
    dialect: Literal["demo5", "2.4"] = "demo5"
    line_end: Literal["dialect", "lf", "crlf"] = "dialect"
    nmea_rule: Literal["nmea", "rtklib"] = "nmea"
    talker: Literal["GP", "GN"] = "GP"
    nmea_interval_s: NmeaInterval = 0.0
    nmea_satellites_interval_s: NmeaInterval = 0.0
    status_level: Literal["state", "residual"] = "state"
    single: bool = False
    max_sigma_m: NotNegative = 0.0
    maximum_delay_s: Annotated[float, Meta(ge=0.1, le=3600.0)] = 15.0
    receiver: str = ""
    mounts: dict[str, str] = {}
    protocol: Literal["rtcm3", "ubx", "nmea", "unicore", "novatel", "sbf", "all"] = "rtcm3"
    messages: tuple[Annotated[int, Meta(ge=1, le=4095)], ...] = ()
    encode: Literal["", "msm4", "msm5", "msm7"] = ""
    station_id: Annotated[int, Meta(ge=0, le=4095)] = 0
    systems: Systems = "GRECJSI"
    interval_s: Interval = 0.0
    bytes_per_second: NotNegative = 0.0
    station_interval_s: Annotated[float, Meta(ge=0.1, le=3600.0)] = 10.0
    ephemeris_interval_s: Annotated[float, Meta(ge=0.0, le=86400.0)] = 0.0
    users: dict[str, str] = {}
    anonymous: bool = False
    maximum_clients: Annotated[int, Meta(ge=1, le=1000)] = 64

    @property
    def scheme(self) -> str:
        """What stands before :// in the target."""
        return self.target.partition("://")[0]

    @property
    def takes_satellites(self) -> bool:
        """Whether the solver's satellites are written, too: of every epoch."""
        wanted = {"nmea": self.nmea_satellites_interval_s >= 0.0, "stat": self.status_level == "residual"}
        return bool(self.solver) and wanted.get(self.format, False)
