"""Files with one mistake each: one clear error with file, line, key, and the nearest right name."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from rtkmesh_services.cli.check import url_errors
from rtkmesh_services.conf.conf_file import parse_conf
from rtkmesh_services.conf.importer import import_conf
from rtkmesh_services.runtime.configuration import ConfigErrors, parse_deployment

Conf = Callable[..., bytes]

# (key, value instead, words of the message): one wrong line each
CONF_MISTAKES = [
    ("pos1-posmode", "kinematik", "did you mean 'kinematic'"),
    ("pos1-posmode", "ppp-kine", "no PPP"),
    ("pos1-posmode", "12", "allowed are 0 single"),
    ("pos1-posmode", "-1", "no value '-1'"),
    ("pos1-frequency", "l2", "did you mean 'l1"),
    ("pos1-frequency", "0", "allowed are 1 l1"),
    ("pos1-elmask", "15 deg", "is no number"),
    ("pos1-elmask", "91", "<= 90"),
    ("pos1-elmask", "-5", ">= 0"),
    ("pos1-elmask", "1e400", "is no number"),
    ("pos1-snrmask_r", "yes", "no value 'yes'"),
    ("pos1-snrmask_L1", "35;35", "nine numbers"),
    ("pos1-snrmask_L1", "1,2,3,4,5,6,7,8,9,10", "nine numbers"),
    ("pos1-exclsats", "G05,GPS6", "'GPS6' is no satellite"),
    ("pos1-navsys", "0", "names no system"),
    ("pos1-navsys", "gps", "is no number"),
    ("pos2-armode", "fixhold", "did you mean 'fix-and-hold'"),
    ("pos2-arthres", "0.5", ">= 1"),
    ("pos2-arthres", "3,0", "is no number"),
    ("pos2-arlockcnt", "2.5", "is no whole number"),
    ("pos2-arlockcnt", "-2", ">= 0"),
    ("pos2-maxage", "0", "> 0"),
    ("pos2-maxage", "30s", "is no number"),
    ("pos2-baselen", "-1", "> 0"),
    ("stats-errphase", "0", "> 0"),
    ("stats-errphase", "3mm", "is no number"),
    ("out-timesys", "gps time", "did you mean 'gpst'"),
    ("out-timendec", "x", "is no number"),
    ("out-outstat", "residuals", "did you mean 'residual'"),
    ("ant2-postype", "rtkm", "did you mean 'rtcm'"),
    ("ant2-postype", "8", "allowed are 0 llh"),
    ("inpstr1-type", "serail", "did you mean 'serial'"),
    ("inpstr2-type", "ntripclient", "did you mean 'ntripcli'"),
    ("inpstr2-type", "5", "no value 5 in demo5"),
    ("inpstr1-format", "ublox", "did you mean 'ubx'"),
    ("inpstr1-format", "ss2", "2.4 has it"),
    ("inpstr1-rcvopt", "-TADJUST=1", "did you mean -TADJ"),
    ("outstr2-type", "tcpsrv", "did you mean 'tcpsvr'"),
    ("outstr2-format", "vel_enu", "2.4 has it"),
    ("misc-timeout", "10 s", "is no number"),
]
CONF_LINES = [
    ("pos1-elmaskk =15", "pos1-elmaskk", "did you mean 'pos1-elmask'"),
    ("pos1_posmode =static", "pos1_posmode", "did you mean 'pos1-posmode'"),
    ("output-format =llh", "output-format", "no key"),
    ("stats-errratio =100", "stats-errratio", "did you mean 'stats-eratio"),
    ("pos2-arthres 3", "", "has no '='"),
    ("[solver]", "", "has no '='"),
    ("pos2-arthr\xebs =3", "pos2-arthr\xebs", "did you mean 'pos2-arthres"),
    ("out-fieldsep =" + "x" * 2100, "", "more than 2047 bytes"),
]


@pytest.mark.parametrize(("key", "value", "words"), CONF_MISTAKES)
def test_a_wrong_value_in_a_conf_file(rtkrcv: Conf, key: str, value: str, words: str):
    """The line that is wrong, and no other; the import goes on as RTKLIB does."""
    data = rtkrcv(**{key.replace("-", "__"): value})
    made = import_conf(parse_conf(data, "a.conf"))
    (error,) = made.conf.wrong
    line = next(number for number, text in enumerate(data.decode().splitlines(), 1) if text.startswith(f"{key} ="))
    assert (error.line, error.key) == (line, key)
    assert error.shown("a.conf").startswith(f"a.conf:{line}: {key}")
    assert words in error.message


@pytest.mark.parametrize(("text", "key", "words"), CONF_LINES)
def test_a_wrong_line_in_a_conf_file(rtkrcv: Conf, text: str, key: str, words: str):
    """A key that is none, a line that is none."""
    data = rtkrcv() + text.encode() + b"\n"
    (error,) = import_conf(parse_conf(data, "a.conf")).conf.wrong
    assert (error.line, error.key) == (data.count(b"\n"), key)
    assert words in error.message


GOOD = """\
[deployment]
name = "test"

[hub]
listen = ["tcp/127.0.0.1:7547"]

[ingest.rover]
source = "tcp://127.0.0.1:5000?timeout=5"

[ingest.base]
source = "ntrip://me:secret@caster.example:2101/ROOF?gga=on"
position_llh_deg = [47.5, 8.5, 500.0]

[solver.rtk]
rover = "rover"
base = "base"
mode = "kinematic"
systems = "GREJC"
frequencies = 2
elevation_mask_deg = 15.0
excluded = ["G05"]

[solver.rtk.ambiguity]
mode = "continuous"
ratio = 3.0

[output.position]
target = "tcp-listen://127.0.0.1:5010"
solver = "rtk"
format = "nmea"

[recorder.logs]
folder = "logs"
receivers = ["rover", "base"]
"""
# (text, instead of it, line, words of the message): one mistake each
TOML_MISTAKES = [
    ("[deployment]", "[deploiment]", 1, "did you mean 'deployment'"),
    ("[hub]", "[hubb]", 4, "did you mean 'hub'"),
    ("[recorder.logs]", "[recorder.Logs]", 32, "Logs"),
    ('source = "tcp:', 'sorce = "tcp:', 8, "did you mean 'source'"),
    ('source = "tcp://127.0.0.1:5000?timeout=5"', "source = 5000", 8, "expected text"),
    ("tcp://127.0.0.1:5000", "tpc://127.0.0.1:5000", 8, "did you mean 'tcp'"),
    ("tcp://127.0.0.1:5000", "tcp://127.0.0.1", 8, "needs host:port"),
    ("tcp://127.0.0.1:5000", "tcp://127.0.0.1:99999", 8, "from 1 to 65535"),
    ("?timeout=5", "?timout=5", 8, "did you mean 'timeout'"),
    ("?timeout=5", "?timeout=soon", 8, "no number"),
    ("caster.example:2101/ROOF", "caster.example:2101", 11, "no mount point"),
    ("?gga=on", "?gga=yes", 11, "allowed are auto, on, off"),
    ("[47.5, 8.5, 500.0]", "[97.5, 8.5, 500.0]", 12, "<= 90"),
    ("[47.5, 8.5, 500.0]", "[47.5, 8.5]", 12, "length 3"),
    ("[47.5, 8.5, 500.0]", '["47.5", 8.5, 500.0]', 12, "expected a number"),
    ("position_llh_deg", "position_lhh_deg", 12, "did you mean 'position_llh_deg'"),
    ("[recorder.logs]", "[recorder]\nlogs = 3\n[recorder.more]", 33, "tables of its own"),
    ('rover = "rover"', 'rover = "rovr"', 15, "did you mean 'rover'"),
    ('base = "base"', 'base = "bases"', 16, "did you mean 'base'"),
    ('base = "base"\n', "", 14, "has no 'base'"),
    ('rover = "rover"\n', "", 14, "has no 'rover'"),
    ('"kinematic"', '"kinematik"', 17, "did you mean 'kinematic'"),
    ('"kinematic"', '"fixed"', 17, "fixed_position_ecef_m"),
    ('"kinematic"', "2", 17, "mode"),
    ('"GREJC"', '"GREJX"', 18, "GRECJSI"),
    ("frequencies = 2", "frequencies = 9", 19, "<= 5"),
    ("frequencies = 2", "frequencies = 2.5", 19, "whole number"),
    ("frequencies = 2", 'frequencies = "two"', 19, "whole number"),
    ("elevation_mask_deg = 15.0", "elevation_mask_deg = 95.0", 20, "<= 90"),
    ("elevation_mask_deg = 15.0", "elevation_mask_deg = nan", 20, "no number"),
    ("elevation_mask_deg", "elevation_mask", 20, "did you mean 'elevation_mask_deg'"),
    ('["G05"]', '["GPS5"]', 21, "no satellite"),
    ('["G05"]', '"G05"', 21, "expected a list"),
    ("[solver.rtk.ambiguity]", "[solver.rtk.ambiguities]", 23, "did you mean 'ambiguity'"),
    ('"continuous"', '"continous"', 24, "did you mean 'continuous'"),
    ("ratio = 3.0", "ratio = 0.3", 25, ">= 1"),
    ("ratio = 3.0", "ratio = true", 25, "expected a number"),
    ("ratio = 3.0", "ratio = 3,0", 25, "no TOML"),
    ('format = "nmea"', 'format = "nema"', 30, "did you mean 'nmea'"),
    ("tcp-listen://127.0.0.1:5010", "tcp-lisen://127.0.0.1:5010", 28, "did you mean 'tcp-listen'"),
    ("tcp-listen://127.0.0.1:5010", "tcp-listen://127.0.0.1", 28, "needs host:port"),
    ('solver = "rtk"', 'solver = "rkt"', 29, "did you mean 'rtk'"),
    ('solver = "rtk"\n', "", 27, "solver or receiver"),
    ("[output.position]", "[output.rtk]", 27, "is taken by"),
    ('"rover", "base"]', '"rover", "bas"]', 34, "did you mean 'base'"),
    ('folder = "logs"\n', "", 32, "has no 'folder'"),
    ("[recorder.logs]", "[recorder.logs", 32, "no TOML"),
    ("[recorder.logs]", "[solver.rtk]", 32, "no TOML"),
    ('name = "test"', 'name = "test', 2, "no TOML"),
    ('name = "test"', 'name = "a"\nname = "b"', 3, "no TOML"),
    ('"tcp/127.0.0.1:7547"', '"tcp/0.0.0.0:7547"', 5, "no loopback address"),
    ("secret@", "${RTKMESH_NO_SUCH_VARIABLE}@", 11, "has no RTKMESH_NO_SUCH_VARIABLE"),
    (GOOD[GOOD.index("excluded") :], 'excluded = ["G05"', 21, "no TOML"),
]


@pytest.mark.parametrize(("text", "instead", "line", "words"), TOML_MISTAKES)
def test_a_mistake_in_a_deployment_file(text: str, instead: str, line: int, words: str, tmp_path: Path):
    """One error, at its line, with the right name."""
    assert GOOD.count(text) >= 1
    file = tmp_path / "a.toml"
    file.write_text(GOOD.replace(text, instead, 1))
    try:
        errors = url_errors(file, parse_deployment(file.read_text(), str(file)))
    except ConfigErrors as error:
        errors = error.errors
    (only,) = errors
    assert (only.file, only.line) == (str(file), line), only
    assert words in only.message
    assert "secret" not in only.message


def test_the_file_without_mistakes_has_no_error(tmp_path: Path):
    """Otherwise the mistakes above would prove little."""
    file = tmp_path / "a.toml"
    file.write_text(GOOD)
    assert url_errors(file, parse_deployment(GOOD, str(file))) == []
    assert len(CONF_MISTAKES) + len(CONF_LINES) + len(TOML_MISTAKES) >= 100
    assert len({re.sub(r"\W", "", words) for *_, words in TOML_MISTAKES}) > 30
