"""The shipped antenna table, and antennas in deployment files."""

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import pytest

from rtkmesh.codecs.antex import write_antex
from rtkmesh.errors import OptionError
from rtkmesh.models.antenna import Antenna
from rtkmesh_schemas.config import SolverTable
from rtkmesh_services.cli.check import check
from rtkmesh_services.mapping.antennas import antenna_finder, shipped_antennas
from rtkmesh_services.mapping.options import session_options

# Types that the recordings of the tests name and the IGS has calibrated; a network's null antennas.
NAMED = (
    "ASH701945C_M    NONE", "LEIAR25.R3      NONE", "LEIAR25.R3      LEIT", "TRM57971.00     NONE", "JAVRINGANT_DM   SCIS",
    "JAVRINGANT_DM   NONE", "LEIAR10         NONE", "TRM29659.00", "TRM29659.00     UNAV", "SEPCHOKE_B3E6   SPKE",
    "ADVNULLANTENNA", "GPPNULLANTENNA",
)  # fmt: skip


@pytest.fixture
def own_file(tmp_path: Path) -> Path:
    """A file with one antenna of the shipped table, under a name of its own."""
    calibration = replace(next(iter(shipped_antennas())), antenna="MYPATCH")
    (tmp_path / "own.atx").write_text(write_antex([calibration]))
    return tmp_path / "own.atx"


def test_the_shipped_table_is_whole_and_small() -> None:
    """Every antenna of it can be decoded and used; at most 300 KB in the package."""
    assert (files("rtkmesh") / "data" / "antennas.atx.xz").stat().st_size <= 300_000  # pyright: ignore[reportAttributeAccessIssue]
    find = antenna_finder()
    names = [f"{antenna} {radome}" for antenna, radome in shipped_antennas().names]
    assert len(names) > 350
    assert [name for name in names if not isinstance(find(name, ""), Antenna)] == []


@pytest.mark.parametrize("name", NAMED)
def test_antennas_of_the_recordings_are_known(name: str) -> None:
    """With their own radome, not with another's."""
    found = antenna_finder()(name, "")
    assert isinstance(found, Antenna)
    assert not found.radome


def test_what_is_not_known_is_said() -> None:
    """A radome falls back to NONE and says so; a type does not."""
    find = antenna_finder()
    assert "radome ABCD not calibrated" in str(find("TRM57971.00     ABCD", ""))
    assert find("Unknown", "") == "no calibration of UNKNOWN NONE"


def test_an_own_file_goes_before_the_shipped_table(own_file: Path) -> None:
    """Its antennas are found beside all others."""
    find = antenna_finder(own_file)
    assert str(find("MYPATCH", "")).startswith("MYPATCH NONE")
    assert isinstance(find("LEIAR10 NONE", ""), Antenna)


def test_an_own_file_that_is_none_is_refused(tmp_path: Path) -> None:
    """Named with what is wrong; a damaged antenna in it is said when it is asked for."""
    with pytest.raises(OptionError, match="No such file"):
        antenna_finder(tmp_path / "none.atx")
    (tmp_path / "bad.atx").write_text("nothing\n")
    with pytest.raises(OptionError, match=r"bad\.atx: the first line"):
        antenna_finder(tmp_path / "bad.atx")
    calibration = next(iter(shipped_antennas()))
    text = write_antex([calibration]).replace("# OF FREQUENCIES", "# OF NOTHING    ")
    (tmp_path / "bad.atx").write_text(text)
    found = antenna_finder(tmp_path / "bad.atx")(f"{calibration.antenna} {calibration.radome}", "")
    assert isinstance(found, str)
    assert calibration.antenna in found


def test_a_solver_table_names_antennas_and_a_file(own_file: Path) -> None:
    """The options of the session have them; the file's name begins at the folder of the configuration."""
    table = SolverTable(rover="r", base="b", rover_antenna="MYPATCH", base_antenna="LEIAR10 NONE", antex=own_file.name)
    options = session_options(table, replay=False, folder=own_file.parent)
    assert (options.rover_antenna, options.base_antenna) == ("MYPATCH", "LEIAR10 NONE")
    assert options.find_antenna is not None
    assert isinstance(options.find_antenna("MYPATCH", ""), Antenna)


DEPLOYMENT = """
[ingest.rover]
source = "tcp://127.0.0.1:1"
[ingest.base]
source = "tcp://127.0.0.1:2"
[solver.rtk]
rover = "rover"
base = "base"
"""


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ('rover_antenna = "MYPATCH"\nantex = "own.atx"', ""),
        ('rover_antenna = "MYPATCH"', "[solver.rtk] rover_antenna: no calibration of MYPATCH NONE"),
        ('base_antenna = "LEIAR11 NONE"', "[solver.rtk] base_antenna: no calibration of LEIAR11 NONE"),
        ('rover_antenna = "MYPATCH"\nantex = "other.atx"', "other.atx: No such file"),
    ],
    ids=["right", "only in the own file", "no such type", "no such file"],
)
def test_check_names_antennas_that_are_not_calibrated(own_file: Path, lines: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    """With the line of the key, and each fault once."""
    file = own_file.parent / "robot.toml"
    file.write_text(DEPLOYMENT + lines + "\n")
    assert (check(file) == 0) is (not says)
    faults = capsys.readouterr().err.splitlines()
    assert len(faults) == bool(says)
    assert all(says in fault and "robot.toml:" in fault for fault in faults)
