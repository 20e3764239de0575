"""A .conf file becomes a deployment: every key is taken, translated, or ignored with the reason; nothing is lost silently."""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtkmesh_services.cli.check import url_errors
from rtkmesh_services.cli.main import run
from rtkmesh_services.conf.conf_file import parse_conf, read_conf
from rtkmesh_services.conf.importer import Imported, import_conf
from rtkmesh_services.conf.report import Became
from rtkmesh_services.conf.table import ALL_ROWS
from rtkmesh_services.errors import ConfError
from rtkmesh_services.runtime.configuration import parse_deployment

Conf = Callable[..., bytes]


def imported(data: bytes, name: str = "") -> Imported:
    return import_conf(parse_conf(data, "rtkrcv.conf"), name)


def test_streams_become_urls(rtkrcv: Conf):
    """Types, paths, options and the password of the inputs."""
    made = imported(rtkrcv())
    ingest = made.tables["ingest"]
    assert ingest["rover"] == {
        "source": "serial:///dev/ttyACM0?baud=460800",
        "observations": "ubx",
        "options": "-TADJ=0.1 -GL2L",
        "commands": {"file": "m8t.cmd"},
    }
    assert ingest["base"]["source"] == (
        "ntrip://ann:${BASE_PASSWORD}@caster.example:2102/ROOF?gga=on&gga_period=2&position=47.5,-8.25,500&timeout=20"
    )
    assert ingest["corrections"] == {"source": "tcp-listen://0.0.0.0:8601?timeout=20", "observations": "rtcm3", "navigation": True}
    assert made.secrets == {"BASE_PASSWORD": "p:w"}


def test_the_solver_is_what_the_file_says(rtkrcv: Conf):
    """Numbers by dialect, masks joined to one, names of ours."""
    solver = imported(rtkrcv()).tables["solver"]["rtk"]
    expected: dict[str, Any] = {
        "rover": "rover", "base": "base", "navigation": ["corrections"], "mode": "moving-base", "frequencies": 3, "systems": "GREC",
        "elevation_mask_deg": 12.5, "cn0_mask_dbhz": 30.0, "excluded": ("G05", "R12"), "max_age_s": 5.0, "baseline_length_m": 1.05,
        "baseline_sigma_m": 0.004, "antex": "igs14.atx", "sync": {"matched_only": True}, "noise": {"code_ratio": 200.0, "phase_a_m": 0.004},
        "dynamics": {"acceleration_horizontal_mps2": 2.0},
        "ambiguity": {
            "mode": "fix-and-hold", "ratio": 2.5, "minimum_lock_epochs": 3, "minimum_ambiguities": 7, "elevation_mask_deg": 20.0,
        },
    }  # fmt: skip
    assert solver == expected


def test_outputs_have_their_own_options(rtkrcv: Conf):
    """out-* go to the outputs whose format they are of."""
    made = imported(rtkrcv()).tables
    assert made["output"]["solution1"] == {
        "target": "file://sol_%Y%m%d.pos?swap=1&margin=10&tags=yes", "solver": "rtk", "format": "llh", "header": "off", "velocity": True,
        "time_system": "utc", "time_form": "tow", "time_decimals": 2, "angles": "dms", "separator": ",", "single": True, "max_sigma_m": 2.0,
    }  # fmt: skip
    assert made["output"]["solution2"] == {
        "target": "tcp-listen://0.0.0.0:5010", "solver": "rtk", "format": "nmea", "single": True, "max_sigma_m": 2.0,
        "nmea_satellites_interval_s": 1.0, "nmea_rule": "rtklib",
    }  # fmt: skip
    assert made["output"]["state_log"] == {"target": "file://rtk.stat", "solver": "rtk", "format": "stat", "status_level": "residual"}
    assert made["recorder"] == {"log1": {"folder": "logs/%Y", "receivers": ["rover"], "swap_hours": 1.0, "tags": True}}
    assert made["output"]["log2"] == {"target": "tcp://logger.example:7001", "receiver": "base", "protocol": "all"}


def test_the_deployment_passes_the_check(rtkrcv: Conf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What is written is a right deployment file, once the secrets are in the environment; another name gives other ids."""
    monkeypatch.setenv("FRONT_BASE_PASSWORD", "x")
    (tmp_path / "m8t.cmd").write_text("!UBX CFG-RATE 200 1 1\n")
    made = imported(rtkrcv(file__rcvantfile=None), "front")
    deployment = parse_deployment(made.toml, "front.toml")
    file = tmp_path / "front.toml"
    file.write_text(made.toml)
    assert url_errors(file, deployment) == []
    assert set(deployment.ingest) == {"front_rover", "front_base", "front_corrections"}
    assert set(deployment.solver) == {"front"}


def test_no_secret_is_written_or_shown(rtkrcv: Conf):
    """Neither the file that is made nor the report has a password."""
    made = imported(rtkrcv())
    shown = made.toml + "".join(f"{row.value} {row.note}" for row in made.rows) + "".join(row.message for row in made.said)
    assert "p:w" not in shown
    assert "open sesame" not in shown
    assert {row.key: row.value for row in made.rows}["inpstr2-path"] == "ann:***@caster.example:2102/ROOF:"


def test_every_key_of_the_dialect_is_in_the_report(rtkrcv: Conf):
    """Once each; those that the file does not say are defaults; what is ignored has a reason."""
    rows = imported(rtkrcv()).rows
    assert [row.key for row in rows] == [name for name, row in ALL_ROWS.items() if row.known_to("demo5")]
    said = {line.partition("=")[0].strip() for line in rtkrcv().decode().splitlines() if not line.startswith("#")}
    assert {row.key for row in rows if row.became is not Became.DEFAULT} == said
    assert all(row.note for row in rows if row.became is Became.IGNORED)


# (lines that are replaced, where in the tables, what is there)
TRANSLATED: list[tuple[dict[str, str | None], str, Any]] = [
    ({"ant2__postype": "llh", "pos1__posmode": "kinematic", "ant2__pos1": "47.5", "ant2__pos2": "8.5", "ant2__pos3": "500"},
     "ingest.base.position_llh_deg", [47.5, 8.5, 500.0]),
    ({"ant2__postype": "xyz", "pos1__posmode": "static", "ant2__pos1": "4278000", "ant2__pos2": "638000", "ant2__pos3": "4672000"},
     "ingest.base.position_ecef_m", [4278000.0, 638000.0, 4672000.0]),
    ({"ant2__postype": "llh", "pos1__posmode": "dgps", "ant2__pos1": "0", "ant2__pos2": "0", "ant2__pos3": "100", "ant2__antdelu": "1.5"},
     "ingest.base.position_llh_deg", [0.0, 0.0, 101.5]),
    ({"ant2__postype": "llh", "pos1__posmode": "dgps", "ant2__pos1": "90", "ant2__pos2": "0", "ant2__pos3": "-6335367.6285"},
     "ingest.base.position_llh_deg", None),
    ({"ant2__postype": "single", "ant2__maxaveep": "600", "pos1__posmode": "static"}, "ingest.base.base_station.minimum_s", 600.0),
    ({"ant2__postype": "single", "pos1__posmode": "movingbase"}, "ingest.base.base_station", None),
    ({"pos1__posmode": "fixed", "ant1__pos1": "0", "ant1__pos2": "0", "ant1__pos3": "0.5"},
     "solver.rtk.fixed_position_ecef_m", [6378137.5, 0.0, 0.0]),
    ({"pos1__posmode": "fixed"}, "solver.rtk.mode", "static"),
    ({"inpstr2__type": "off"}, "solver.rtk.mode", "single"),
    ({"inpstr1__type": "file", "inpstr1__path": "a.ubx"}, "ingest.rover.source", "file://a.ubx?speed=max"),
    ({"inpstr1__type": "file", "inpstr1__path": "a.ubx::T::+30::x10::P=4"}, "ingest.rover.source",
     "file://a.ubx?times=yes&start=30&speed=10"),
    ({"inpstr1__type": "tcpcli", "inpstr1__path": ":@:2000/:", "misc__timeout": None}, "ingest.rover.source", "tcp://127.0.0.1:2000"),
    ({"inpstr1__type": "tcpcli", "inpstr1__path": "HOST:PORT"}, "ingest.rover.source", "${ROVER_SOURCE}"),
    ({"inpstr1__type": "off"}, "ingest.rover.source", "${ROVER_SOURCE}"),
    ({"inpstr2__nmeareq": "off", "misc__timeout": "10000"}, "ingest.base.source",
     "ntrip://ann:${BASE_PASSWORD}@caster.example:2102/ROOF?gga=off"),
    ({"inpstr1__format": "oem4"}, "ingest.rover.observations", "novatel"),
    ({"inpstr1__format": "javad"}, "ingest.rover.observations", None),
    ({"outstr1__type": "ntripsvr", "outstr1__path": ":pw@c.example/M"}, "output.solution1.target",
     "ntrip://:${SOLUTION1_PASSWORD}@c.example:80/M"),
    ({"outstr1__type": "udpcli", "outstr1__path": "10.0.0.255:4000"}, "output.solution1.target", "udp://10.0.0.255:4000"),
    ({"outstr1__type": "file", "outstr1__path": ""}, "output.solution1.target", "stdout://"),
    ({"outstr1__type": "9", "outstr1__path": "me:pw@:2105/SOL"}, "output.solution1.users", {"me": "${SOLUTION1_PASSWORD}"}),
    ({"pos1__snrmask_r": "off"}, "solver.rtk.cn0_mask_dbhz", None),
    ({"pos1__dynamics": "off"}, "solver.rtk.dynamics", None),
    ({"stats__eratio1": "300"}, "solver.rtk.noise.code_ratio", None),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "path", "expected"), TRANSLATED)
def test_single_keys(rtkrcv: Conf, changes: dict[str, str | None], path: str, expected: Any):
    """What one or a few keys give."""
    value: Any = imported(rtkrcv(**changes)).tables
    for name in path.split("."):
        value = (value or {}).get(name)
    assert value == (pytest.approx(expected, abs=1e-6) if isinstance(expected, list) else expected)


# (lines that are replaced, the key, words of its note): what is asked for and not done
NOT_DONE: list[tuple[dict[str, str | None], str, str]] = [
    ({"pos1__sateph": "precise"}, "pos1-sateph", "broadcast"),
    ({"pos1__tidecorr": "3"}, "pos1-tidecorr", "ocean loading"),
    ({"pos2__gloarmode": "off"}, "pos2-gloarmode", "GLONASS"),
    ({"inpstr1__format": "javad"}, "inpstr1-format", "no decoder of javad"),
    ({"inpstr3__type": "ftp"}, "inpstr3-type", "products"),
    ({"inpstr1__type": "ntripcli", "inpstr1__path": "h.example/M"}, "file-cmdfile1", "nobody hears"),
    ({"inpstr2__type": "tcpcli", "inpstr2__path": "h.example:1"}, "inpstr2-nmeareq", "casters alone"),
    ({"misc__startcmd": "./start.sh"}, "misc-startcmd", "not run"),
    ({"misc__proxyaddr": "proxy:80"}, "misc-proxyaddr", "no proxies"),
    ({"out__geoid": "egm96"}, "out-geoid", "egm96"),
    ({"ant1__antdelu": "2"}, "ant1-antdelu", "those of the antenna"),
    ({"pos1__exclsats": "+E11"}, "pos1-exclsats", "never used"),
    ({"inpstr1__path": "ttyACM0:460800:7:e:2:rts"}, "inpstr1-path", "bits 7, parity e, stop 2, flow rts"),
]


@pytest.mark.parametrize(("changes", "key", "words"), NOT_DONE)
def test_what_is_not_done_is_named(rtkrcv: Conf, changes: dict[str, str | None], key: str, words: str):
    """A wish that is not fulfilled is marked, with the reason."""
    row = next(row for row in imported(rtkrcv(**changes)).rows if row.key == key)
    assert words in row.note
    assert row.alters or key == "inpstr1-path"


@pytest.mark.data
def test_all_files_of_the_wild_become_deployments(confs: list[Path], monkeypatch: pytest.MonkeyPatch):
    """The seven of rtkrcv_ros, demo5's and 2.4.1's: right deployments, the dialect known without doubt."""
    assert len(confs) >= 17
    for path in confs:
        made = import_conf(read_conf(path))
        assert made.conf.dialect == ("demo5" if re.search("m8[nt]|f9p|rtknavi", path.name) else "2.4"), path
        assert made.conf.guess.against == "", path
        for name in (*made.secrets, *made.open):
            monkeypatch.setenv(name, "tcp-listen://127.0.0.1:5000")
        if made.streams:
            assert parse_deployment(made.toml, str(path)).solver["rtk"].rover == "rover"
        else:
            assert set(tomllib.loads(made.toml)) == {"solver"}


@pytest.mark.data
def test_the_traps_of_rtkrcv_ros(confs: list[Path]):
    """rejionno=30 and tidecorr=on mean what 2.4.2 means; read as demo5 they are told; the typo tcpsrv is found."""
    path = next(path for path in confs if path.name == "dual_antenna_mbl.conf")
    old = import_conf(read_conf(path))
    rows = {row.key: row for row in old.rows}
    assert not rows["pos1-tidecorr"].alters
    assert not rows["pos2-rejionno"].alters
    assert old.solver.mode == "moving-base"
    assert old.solver.sync.matched_only
    assert [(row.line, row.key) for row in old.conf.wrong] == [(116, "outstr2-type")]
    assert "did you mean 'tcpsvr'" in old.conf.wrong[0].message
    new = import_conf(read_conf(path, "demo5"))
    told = {row.key: row.message for row in new.said}
    assert "rejects none" in told["pos2-rejionno"]
    assert "key of 2.4" in told["pos2-rejgdop"]
    assert "reads 'on' as 0" in next(row.note for row in new.rows if row.key == "pos1-tidecorr")


@pytest.mark.parametrize("value", ["on", "off"])
@pytest.mark.parametrize("source", ["file", "serial"])
def test_interpolation_is_of_recordings(value: str, source: str):
    """RTKLIB's on is taken where both inputs are files, and of a file without streams; off, its default, is no wish of the file's."""
    paths = {"file": "{}.ubx", "serial": "tty{}:9600:8:n:1:off"}
    streams = "".join(f"inpstr{k}-type ={source}\ninpstr{k}-path ={paths[source].format(k)}\ninpstr{k}-format =ubx\n" for k in (1, 2))
    post = f"pos1-posmode =kinematic\nmisc-timeinterp ={value}\n"
    live = import_conf(parse_conf((streams + post).encode(), "f"))
    assert live.solver.sync.interpolate == (True if (value, source) == ("on", "file") else None)
    alone = import_conf(parse_conf(post.encode(), "f"))
    assert alone.solver.sync.interpolate == (True if value == "on" else None)
    row = next(row for row in live.rows if row.key == "misc-timeinterp")
    assert row.alters == ((value, source) == ("on", "serial"))


def test_the_dialect_is_found_or_doubted():
    """By keys, names, lists and titles; what speaks against it is told; without anything it is demo5."""
    assert parse_conf(b"pos2-arfilter =on\n", "f").dialect == "demo5"
    assert parse_conf(b"pos2-rejgdop =30\n", "f").dialect == "2.4"
    assert parse_conf(b"pos1-posmode =kinematic # (3:static,4:movingbase)\n", "f").dialect == "2.4"
    assert parse_conf(b"# RTKNAVI options (2016, v.2.4.3 b24)\n", "f").dialect == "2.4"
    assert parse_conf(b"pos1-elmask =15\n", "f").guess.why.startswith("nothing")
    both = parse_conf(b"pos2-rejgdop =30\npos2-arfilter =on\npos2-rejphase =2\n", "f").guess
    assert both.dialect == "demo5"
    assert both.against == "pos2-rejgdop is a key of 2.4 alone (line 1)"


def test_lines_are_read_as_rtklib_reads_them():
    """CR LF, a mark before the first byte, no UTF-8, blanks, doubles, parts of names, lines that are none: taken, and told."""
    text = b"\xef\xbb\xbfpos1-elmask =10\r\npos1-posmode = static\r\nposmode =kinematic\r\npos1-elmask =12\r\nnonsense\r\n"
    text += b"out-fieldsep =\xb0\r\n"
    with_latin = parse_conf(text.replace(b"\xef\xbb\xbf", b""), "f")
    assert with_latin.text("out-fieldsep") == "°"
    assert with_latin.text("pos1-elmask") == "12"
    assert with_latin.choice("pos1-posmode") == "kinematic"
    told = "\n".join(row.shown("f") for row in with_latin.said)
    for words in ("f:6: is no UTF-8", "f:2: pos1-posmode: RTKLIB does not know 'static'", "f:3: 'posmode' is no key: RTKLIB takes it",
                  "f:4: pos1-elmask again: this line counts, not line 1", "f:5: 'nonsense' has no '='"):  # fmt: skip
        assert words in told
    assert parse_conf(text[:20], "f").text("pos1-elmask") == "10"


@pytest.mark.parametrize("data", [b"\0" * 10, b"x" * (1 << 20) + b"y"])
def test_what_is_no_conf_file_is_refused(data: bytes):
    with pytest.raises(ConfError):
        parse_conf(data, "f")


def test_the_command_writes_and_never_replaces(rtkrcv: Conf, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """--out, --secrets (its owner's alone), exit codes, --strict."""
    conf, out, secrets = tmp_path / "a.conf", tmp_path / "a.toml", tmp_path / "a.env"
    conf.write_bytes(rtkrcv())
    assert run(["conf", "import", str(conf), "--out", str(out), "--secrets", str(secrets)]) == 0
    assert "asked for by the file and not done" in capsys.readouterr().err
    assert secrets.read_text() == 'BASE_PASSWORD="p:w"\n'
    assert secrets.stat().st_mode & 0o777 == 0o600
    before = out.read_bytes()
    assert run(["conf", "import", str(conf), "--out", str(out)]) == 2
    assert out.read_bytes() == before
    conf.write_bytes(rtkrcv(pos1__elmaskk="3"))
    assert run(["conf", "import", str(conf)]) == 1
    assert run(["conf", "import", str(conf), "--strict", "--out", str(tmp_path / "b.toml")]) == 2
    assert not (tmp_path / "b.toml").exists()
    assert run(["conf", "import", str(tmp_path / "none.conf")]) == 2
