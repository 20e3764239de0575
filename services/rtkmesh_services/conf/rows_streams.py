"""rtkrcv's own keys: console, streams, the server. One row, one line: it is a table."""

from typing import Final

from rtkmesh_services.conf import choices as c
from rtkmesh_services.conf.rows import Fate, Kind, Row

_T, _R, _I = Fate.TAKEN, Fate.TRANSLATED, Fate.IGNORED
_INT, _NUM, _TEXT, _ENUM = Kind.INTEGER, Kind.NUMBER, Kind.TEXT, Kind.CHOICE
_INGESTS: Final = (("1", "rover"), ("2", "base"), ("3", "corrections"))
_SHELL: Final = "commands of a shell are not run: a supervisor (systemd) has hooks of its own"
_CONSOLE: Final = "of the console alone: its words take the form as an argument"

# fmt: off
_INPUTS: Final = tuple(
    row
    for number, id_ in _INGESTS
    for row in (
        Row(f"inpstr{number}-type", _ENUM, "serial" if number == "1" else "off", _T, f"ingest.{id_}.source", "the URL's scheme; ftp and http bring products that are not read", None, c.INPUT_TYPES),
        Row(f"inpstr{number}-path", _TEXT, "", _R, f"ingest.{id_}.source", "the URL; its user's password becomes a reference to the environment"),
        Row(f"inpstr{number}-format", _ENUM, {"1": "ubx", "2": "rtcm3", "3": "sp3"}[number], _T, f"ingest.{id_}.observations", "ubx, rtcm3, sbf, unicore, oem4 (novatel); rinex of recordings; others have no decoder", None, c.INPUT_FORMATS),
        Row(f"inpstr{number}-rcvopt", _TEXT, "", _T, f"ingest.{id_}.options", only="demo5"),
    )
)
_OUTPUTS: Final = tuple(
    row
    for number in "12"
    for row in (
        Row(f"outstr{number}-type", _ENUM, "off", _T, f"output.solution{number}.target", "the URL's scheme; ros is the key of that name and the bridge [ros2]", None, c.OUTPUT_TYPES),
        Row(f"outstr{number}-path", _TEXT, "", _R, f"output.solution{number}.target", "the URL; its user's password becomes a reference to the environment"),
        Row(f"outstr{number}-format", _ENUM, "llh" if number == "1" else "nmea", _T, f"output.solution{number}.format", "goes before out-solformat", None, c.OUTPUT_FORMATS),
    )
)
_LOGS: Final = tuple(
    row
    for number, id_ in _INGESTS
    for row in (
        Row(f"logstr{number}-type", _ENUM, "off", _R, f"recorder.log{number}", f"file: a recorder of {id_}; others: an output of {id_}'s frames", None, c.OUTPUT_TYPES),
        Row(f"logstr{number}-path", _TEXT, "", _R, f"recorder.log{number}.folder", "the folder; the recorder names its files itself"),
    )
)
ROWS: Final = (
    Row("console-passwd", _TEXT, "admin", _R, "", "say it in [telnet.ID] of the deployment, as a reference to the environment"),
    Row("console-timetype", _ENUM, "gpst", _I, "", _CONSOLE, None, c.CONSOLE_TIMES),
    Row("console-soltype", _ENUM, "dms", _I, "", _CONSOLE, None, c.CONSOLE_FORMS),
    Row("console-solflag", _INT, "2", _I, "", _CONSOLE),
    *_INPUTS,
    Row("inpstr2-nmeareq", _ENUM, "off", _T, "ingest.base.source", "?gga and ?position of the URL, of casters alone", None, c.NMEA_REQUESTS),
    Row("inpstr2-nmealat", _NUM, "0", _T, "ingest.base.source", "?position, with nmeareq=latlon"),
    Row("inpstr2-nmealon", _NUM, "0", _T, "ingest.base.source", "?position, with nmeareq=latlon"),
    Row("inpstr2-nmeahgt", _NUM, "0", _T, "ingest.base.source", "?position, with nmeareq=latlon"),
    *_OUTPUTS,
    *_LOGS,
    Row("misc-svrcycle", _INT, "10", _I, "", "nothing here runs in cycles: an epoch is solved when its last byte has come"),
    Row("misc-timeout", _INT, "10000", _R, "ingest.*.source", "?timeout of the URLs, in seconds"),
    Row("misc-reconnect", _INT, "10000", _I, "", "a lost source is opened again after 0.1 to 0.5 s, a caster after 1 to 60 s"),
    Row("misc-nmeacycle", _INT, "5000", _R, "ingest.base.source", "?gga_period of the URL, in seconds"),
    Row("misc-buffsize", _INT, "32768", _I, "", "buffers grow with the frames, up to a bound"),
    Row("misc-navmsgsel", _ENUM, "all", _I, "", "ephemerides of all sources are used, the newest and soundest of each satellite", None, c.NAVIGATION),
    Row("misc-proxyaddr", _TEXT, "", _I, "", "there are no proxies: casters are reached directly"),
    Row("misc-fswapmargin", _INT, "30", _T, "output.*.target", "?margin of files that are swapped"),
    Row("misc-startcmd", _TEXT, "", _I, "", _SHELL),
    Row("misc-stopcmd", _TEXT, "", _I, "", _SHELL),
    *(Row(f"file-cmdfile{number}", _TEXT, "", _T, f"ingest.{id_}.commands.file", "serial, tcpcli and tcpsvr alone") for number, id_ in _INGESTS),
)
# fmt: on
