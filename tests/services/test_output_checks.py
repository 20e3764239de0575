"""`rtkmesh check` on outputs: each key that has no meaning, each target that is none, each port that is somebody else's, by its line."""

from pathlib import Path

import pytest

from rtkmesh_schemas.config import OutputTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_services.errors import SourceError
from rtkmesh_services.output.targets import SCHEMES, check_output, parse_target
from rtkmesh_services.runtime.configuration import parse_deployment
from rtkmesh_services.runtime.port_owners import ingest_of_port

SITE = """[ingest.rover]
source = "serial:///dev/ttyROVER?baud=460800"
[ingest.base]
source = "udp://:7000"
fallback = ["serial://by-id/usb-radio"]
[solver.rtk]
rover = "rover"
base = "base"
[output.out]
"""
TWO = 'target = "serial:///dev/ttyX"\nsolver = "rtk"\n[output.two]\ntarget = "serial:///dev/ttyX"\nsolver = "rtk"\n'
TARGET_LINE = SITE.count("\n") + 1
TEXT = 'target = "file://x.pos"\nsolver = "rtk"\n'
FRAMES = 'target = "file://x.rtcm"\nreceiver = "base"\n'
# lines of [output.out] -> (line among them, what is said)
FAULTS = {
    TEXT + 'format = "lhl"\n': (3, "allowed are llh, xyz, enu, vel_enu, nmea, stat, json; did you mean 'llh'?"),
    TEXT + 'formt = "llh"\n': (3, "unknown key 'formt'; did you mean 'format'?"),
    TEXT + 'format = "xyz"\nangles = "dms"\n': (4, "angles is of format llh, and this is xyz"),
    TEXT + 'format = "enu"\nvelocity = true\n': (4, "velocity is of format llh, xyz, and this is enu"),
    TEXT + 'format = "nmea"\nseparator = ","\n': (4, "separator is of format llh, xyz, enu, vel_enu, and this is nmea"),
    TEXT + "nmea_interval_s = 1.0\n": (3, "nmea_interval_s is of format nmea, and this is llh"),
    TEXT + 'status_level = "residual"\n': (3, "status_level is of format stat, and this is llh"),
    TEXT + 'format = "stat"\nmax_sigma_m = 1.0\n': (4, "max_sigma_m is of format llh, xyz, enu, vel_enu, nmea, json, and this is stat"),
    TEXT + 'format = "json"\nsingle = true\n': (4, "single is of format"),
    TEXT + "time_decimals = 13\n": (3, "time_decimals"),
    TEXT + 'separator = "%"\n': (3, "separator"),
    TEXT + "messages = [1005]\n": (3, "messages is about a receiver's frames, and this writes a solver's solutions"),
    TEXT + "station_id = 7\n": (3, "station_id is about frames that are made: it needs encode"),
    FRAMES + "max_sigma_m = 0.1\n": (3, "max_sigma_m is about a solver's text, and this sends a receiver's frames"),
    FRAMES + 'format = "nmea"\n': (3, "format is about a solver's text"),
    FRAMES + "interval_s = 1.0\n": (3, "interval_s is about frames that are made: it needs encode"),
    TEXT + "maximum_clients = 3\n": (3, "maximum_clients is of targets ntrip-caster://, tcp-listen://"),
    TEXT + "maximum_delay_s = 3.0\n": (3, "maximum_delay_s is of targets serial://, tcp://"),
    TEXT + "anonymous = true\n": (3, "anonymous is of targets ntrip-caster://"),
    'target = "serial:///dev/ttyROVER?baud=9600"\nsolver = "rtk"\n': (1, "the port is that of [ingest.rover], which has it at 460800"),
    TWO: (4, "[output.out] has this port"),
    'target = "ingest://rovr"\nsolver = "rtk"\n': (1, "no [ingest.rovr]; did you mean 'rover'?"),
    'target = "file://x"\nsolver = "rtx"\n': (2, "no [solver.rtx]; did you mean 'rtk'?"),
    'target = "ntrip-caster://127.0.0.1"\nsolver = "rtk"\n': (0, "has 'solver' where it needs mounts (or, with a mount point"),
    'target = "ntrip-caster://127.0.0.1/POS"\nmounts = { POS = "base" }\n': (0, "has 'mounts' where it needs solver or receiver"),
}  # fmt: skip


@pytest.mark.parametrize("text", FAULTS, ids=[says[:40] for _, says in FAULTS.values()])
def test_each_fault_is_told_with_its_line(text: str) -> None:
    line, says = FAULTS[text]
    with pytest.raises(ConfigError) as raised:
        parse_deployment(SITE + text, "site.toml")
    [told] = str(raised.value).splitlines()
    assert says in told
    assert told.startswith(f"site.toml:{TARGET_LINE - 1 + line}: ")


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("fiel://x", "unknown target; did you mean 'file'?"),
        ("file://", "needs a path"),
        ("file://x?swop=1", "unknown option 'swop'; known are swap, margin, tags"),
        ("file://x?swap=-1", "no number of hours"),
        ("file://x?margin=4000", "no number of seconds up to 3600"),
        ("serial://ttyS0", "names no port"),
        ("serial:///dev/ttyS0?baud=fast", "no number of bits per second"),
        ("tcp://host", "needs host:port"),
        ("tcp://host:70000", "needs host:port"),
        ("udp://host:1/x", "needs host:port and nothing behind it"),
        ("tcp://host:1?timeout=3", "tcp:// has none"),
        ("ingest://No", "is no id"),
        ("stdout://x", "has nothing behind ://"),
        ("zenoh://rtk/rtk/sol", "keys below rtk/ have their owners"),
        ("zenoh://a//b", "is no key"),
        ("zenoh://a/*", "is no key"),
    ],
)
def test_each_wrong_target_says_why(url: str, says: str) -> None:
    with pytest.raises(SourceError) as raised:
        parse_target(url)
    assert says in str(raised.value)


def test_right_targets_are_told_as_they_are() -> None:
    for url in (
        "file:///logs/%Y.pos",
        "serial:///dev/ttyS0",
        "tcp://h:1",
        "ntrip-caster://127.0.0.1:2101/POS",
        "zenoh://a/b",
        "ingest://rover",
    ):
        assert str(parse_target(url)) == url
    assert str(parse_target("ntrip-caster://127.0.0.1/POS")) == "ntrip-caster://127.0.0.1:2101/POS"
    assert set(SCHEMES) >= {"file", "serial", "tcp", "tcp-listen", "udp", "ntrip", "ntrips", "ntrip-caster", "zenoh", "stdout", "ingest"}


def test_a_caster_of_texts_asks_for_users_as_well() -> None:
    with pytest.raises(SourceError, match="everybody could read"):
        check_output(OutputTable(target="ntrip-caster://0.0.0.0:2101/POS", solver="rtk"))
    check_output(OutputTable(target="ntrip-caster://0.0.0.0:2101/POS", solver="rtk", users={"a": "b"}))


def test_ports_are_the_same_by_any_name(tmp_path: Path) -> None:
    """A link leads to the device; what is not plugged in is known by its name only."""
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "receiver").symlink_to(tmp_path / "ttyACM0")
    site = SITE.replace("/dev/ttyROVER", f"{tmp_path}/ttyACM0")
    deployment = parse_deployment(site + TEXT, "site.toml")
    assert ingest_of_port(deployment, f"serial://{tmp_path}/receiver") == "rover"
    assert ingest_of_port(deployment, f"serial://{tmp_path}/tty*") == "rover"
    assert ingest_of_port(deployment, "serial://by-id/usb-radio?baud=9600") == "base"
    assert ingest_of_port(deployment, "serial://by-id/usb-other") == ""
    assert ingest_of_port(deployment, "tcp://host:1") == ""


def test_what_belongs_together_passes() -> None:
    rows = [
        TEXT + 'angles = "dms"\nheight = "geodetic"\nvelocity = true\nseparator = "\\\\t"\ntime_system = "jst"\nheader = "none"\n',
        TEXT + 'format = "nmea"\ntalker = "GN"\nnmea_interval_s = 0.2\nnmea_satellites_interval_s = -1\ninterval_s = 1.0\n',
        TEXT + 'format = "stat"\nstatus_level = "residual"\nsingle = true\n',
        'target = "tcp-listen://127.0.0.1:1"\nsolver = "rtk"\nmaximum_clients = 3\nmaximum_delay_s = 2\n',
        'target = "serial:///dev/ttyROVER"\nsolver = "rtk"\n',
        'target = "ntrip-caster://127.0.0.1/POS"\nreceiver = "base"\n',
        FRAMES + 'encode = "msm7"\ninterval_s = 1.0\nstation_id = 3\n',
    ]
    for row in rows:
        assert parse_deployment(SITE + row, "site.toml").output["out"].target
