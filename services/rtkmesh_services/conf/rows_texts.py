"""The keys out-, ant1-, ant2-, misc- and file-: what is written, where the antennas are. One row, one line: it is a table."""

from typing import Final

from rtkmesh_services.conf import choices as c
from rtkmesh_services.conf.rows import Fate, Kind, Row

_T, _R, _I = Fate.TAKEN, Fate.TRANSLATED, Fate.IGNORED
_NUM, _INT, _TEXT, _ENUM = Kind.NUMBER, Kind.INTEGER, Kind.TEXT, Kind.CHOICE
_LLH: Final = "of llh"
_TABLES: Final = "of the four texts llh, xyz, enu, vel_enu"
_POST: Final = "of post-processing and PPP, which have no such file here"
_OFFSET: Final = "where the position of the base is given it is moved by this; of the rover: positions are those of its antenna"

# fmt: off
_ANTENNAS: Final = tuple(
    row
    for number, place, id_ in (("1", "solver.fixed_position_ecef_m", "rover"), ("2", "ingest.base.position_llh_deg or position_ecef_m", "base"))
    for row in (
        Row(f"ant{number}-postype", _ENUM, "llh", _R, place, "single: the base's fixes are averaged; rtcm, rinexhead, posfile: what its stream says" if number == "2" else "of mode fixed alone", None, c.POSITIONS),
        *(Row(f"ant{number}-pos{axis}", _NUM, "0", _T, place, "degrees, degrees, m with llh; m with xyz" if number == "2" else "of mode fixed alone") for axis in "123"),
        Row(f"ant{number}-anttype", _TEXT, "", _T, f"solver.{id_}_antenna", "`*` and nothing: what the stream says"),
        *(Row(f"ant{number}-antdel{axis}", _NUM, "0", _R, "ingest.base.position_*" if number == "2" else "", _OFFSET) for axis in "enu"),
    )
)
ROWS: Final = (
    Row("out-solformat", _ENUM, "llh", _R, "output.*.format", "of rnx2rtkp: rtkmesh solve --format; outstr1-format and outstr2-format go before it", None, c.SOLUTION_FORMATS),
    Row("out-outhead", _ENUM, "on", _T, "output.*.header", _TABLES, None, c.SWITCH),
    Row("out-outopt", _ENUM, "off", _T, "output.*.header_options", _TABLES, None, c.SWITCH),
    Row("out-outvel", _ENUM, "off", _T, "output.*.velocity", "of llh and xyz; enu has none in RTKLIB either", None, c.SWITCH),
    Row("out-timesys", _ENUM, "gpst", _T, "output.*.time_system", _TABLES, None, c.TIME_SYSTEMS),
    Row("out-timeform", _ENUM, "hms", _T, "output.*.time_form", _TABLES, None, c.TIME_FORMS),
    Row("out-timendec", _INT, "3", _T, "output.*.time_decimals", "at most 12"),
    Row("out-degform", _ENUM, "deg", _T, "output.*.angles", _LLH, None, c.ANGLES),
    Row("out-fieldsep", _TEXT, "", _T, "output.*.separator", "empty: a blank"),
    Row("out-outsingle", _ENUM, "off", _T, "output.*.single", "2.4.2 always writes them", "on", c.SWITCH),
    Row("out-maxsolstd", _NUM, "0", _T, "output.*.max_sigma_m"),
    Row("out-height", _ENUM, "ellipsoidal", _T, "output.*.height", _LLH, None, c.HEIGHTS),
    Row("out-geoid", _ENUM, "internal", _I, "", "there is one model, EGM96 on RTKLIB's internal grid", None, c.GEOIDS),
    Row("out-solstatic", _ENUM, "all", _I, "", "of post-processing: every epoch is written", None, c.STATIC_SOLUTIONS),
    Row("out-nmeaintv1", _NUM, "0", _T, "output.*.nmea_interval_s", "of nmea: RMC, GGA, GST"),
    Row("out-nmeaintv2", _NUM, "0", _T, "output.*.nmea_satellites_interval_s", "of nmea: GSA, GSV"),
    Row("out-outstat", _ENUM, "off", _R, "output.status", "state or residual: an output of format stat", None, c.STATUS_LEVELS),
    *_ANTENNAS,
    Row("ant2-maxaveep", _INT, "1", _R, "ingest.base.base_station.minimum_s", "epochs of the average, taken for seconds; 0: as long as it runs", "0"),
    Row("ant2-initrst", _ENUM, "on", _I, "", "an average begins anew with every start", "off", c.SWITCH),
    Row("misc-sbasatsel", _INT, "0", _I, "", "SBAS corrections are not read"),
    Row("misc-rnxopt1", _TEXT, "", _I, "", "options of RINEX files; those of logs are ingest options"),
    Row("misc-rnxopt2", _TEXT, "", _I, "", "options of RINEX files; those of logs are ingest options"),
    Row("misc-pppopt", _TEXT, "", _I, "", "of PPP, which there is not"),
    Row("file-satantfile", _TEXT, "", _I, "", "satellite antennas count in PPP alone"),
    Row("file-rcvantfile", _TEXT, "", _T, "solver.antex", "an ANTEX file that goes before the shipped calibrations"),
    *(Row(f"file-{name}file", _TEXT, "", _I, "", _POST) for name in ("stapos", "geoid", "iono", "dcb", "eop", "blq")),
    Row("file-tempdir", _TEXT, "", _I, "", "nothing is downloaded, no folder for it is needed"),
    Row("file-geexefile", _TEXT, "", _I, "", "there is no Google Earth to start"),
    Row("file-solstatfile", _TEXT, "", _R, "output.status.target", "the file of out-outstat"),
    Row("file-tracefile", _TEXT, "", _I, "", "logs go to the journal, by --log-level"),
)
# fmt: on
