"""Options of a solver by name: checked as those of a file, at once where the filter goes on, and in files below one folder."""

import os
import socket
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.rtk.continuation import Continuation
from rtkmesh.rtk.session import Session
from rtkmesh_schemas.command import Code
from rtkmesh_schemas.config import AmbiguityTable, IntegrityTable, NoiseTable, SolverTable, SyncTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_services.errors import CommandError
from rtkmesh_services.mapping.options import session_options
from rtkmesh_services.runtime.configuration import parse_solver_table
from rtkmesh_services.runtime.files_below import read_below, write_below
from rtkmesh_services.runtime.toml_text import toml_table
from rtkmesh_services.solver.options import options_of, with_option
from rtkmesh_services.solver.settings import Settings

TABLE = SolverTable(rover="rover", base="base")


@pytest.fixture
def settings() -> Settings:
    """Settings around a real session that has not solved anything yet."""
    session = Session(session_options(TABLE, replay=False))

    def go_on(table: SolverTable) -> Continuation:
        return session.go_on(session_options(table, replay=False))

    return Settings(TABLE, lambda table: Session(session_options(table, replay=False)), go_on)


@pytest.mark.parametrize(
    ("name", "given", "expected"),
    [
        ("elevation_mask_deg", "12.5", 12.5),
        ("elevation_mask_deg", 20, 20.0),
        ("ambiguity.ratio", "2", 2.0),
        ("ambiguity.ratio", "", None),
        ("ambiguity.mode", "fix-and-hold", "fix-and-hold"),
        ("sync.matched_only", "on", True),
        ("sync.matched_only", False, False),
        ("excluded", "G05, R12", ("G05", "R12")),
        ("excluded", ["E11"], ("E11",)),
        ("excluded", None, ()),
        ("fixed_position_ecef_m", "1.0 2 3", (1.0, 2.0, 3.0)),
        ("mode", "static", "static"),
        ("antex", "antennas.atx", "antennas.atx"),
        ("baseline_length_m", "none", CommandError),
    ],
)
def test_values_are_read_as_people_and_programs_write_them(name: str, given: object, expected: object) -> None:
    if expected is CommandError:
        with pytest.raises(CommandError, match=f"invalid option value: {name}"):
            with_option(TABLE, name, given)
        return
    assert options_of(with_option(TABLE, name, given))[name] == expected


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("elevation_mask_dg", 10, "no option type: elevation_mask_dg; did you mean 'elevation_mask_deg'?"),
        ("elevation_mask_deg", 91, "<= 90"),
        ("elevation_mask_deg", "high", "invalid option value: elevation_mask_deg high"),
        ("ambiguity.ratio", 0.5, ">= 1"),
        ("mode", "movng-base", "did you mean 'moving-base'"),
        ("rover", "other", "is a stream"),
        ("elevation_mask_deg", {"a": 1}, "is no value of an option"),
        ("mode\n[ingest", "x", "no option type"),
        ("antex", "\ud800", "surrogates not allowed"),
    ],
)
def test_what_is_wrong_is_said_in_rtkrcvs_words_with_the_nearest_right_name(name: str, value: object, text: str) -> None:
    with pytest.raises(CommandError) as refusal:
        with_option(TABLE, name, value)
    assert text in str(refusal.value)
    assert "\n" not in str(refusal.value)


@given(st.text(max_size=40), st.text(max_size=40) | st.integers() | st.floats() | st.lists(st.text(max_size=5), max_size=5))
def test_no_name_and_no_value_gets_past_the_checks(name: str, value: object) -> None:
    for option in (name, "excluded", "mode", "ambiguity.ratio"):
        try:
            changed = with_option(TABLE, option, value)
        except CommandError:
            continue
        assert msgspec.convert(msgspec.to_builtins(changed), SolverTable) == changed
        assert (changed.rover, changed.base) == ("rover", "base")


def test_a_change_acts_at_once_or_waits_for_a_restart(settings: Settings) -> None:
    live = settings.set("elevation_mask_deg", 20)
    assert (live.at_once, live.changes) == (True, {"elevation_mask_deg": (15.0, 20.0)})
    assert settings.active.elevation_mask_deg == 20.0
    waits = settings.set("mode", "single")
    assert (waits.at_once, waits.data()["applied"]) == (False, "on_restart")
    assert "different states" in waits.data()["reason"]
    assert (settings.active.mode, settings.pending.mode) == ("kinematic", "single")
    assert settings.told("mode")["mode"] == {"value": "kinematic", "pending": "single"}
    assert settings.set("cn0_mask_dbhz", 30).at_once, "what waits holds up nothing else"
    assert (settings.active.mode, settings.active.cn0_mask_dbhz) == ("kinematic", 30.0)
    settings.restarted()
    assert settings.active == settings.pending
    assert settings.active.mode == "single"


def test_the_engine_refuses_before_anything_is_changed(settings: Settings) -> None:
    before = settings.pending
    with pytest.raises(Exception, match="fixed_position_ecef_m"):
        settings.set("mode", "fixed")
    assert settings.pending is before


@pytest.mark.parametrize(
    ("key", "value", "name", "expected"),
    [
        ("pos1-elmask", "12", "elevation_mask_deg", 12.0),
        ("pos1-posmode", "static", "mode", "static"),
        ("pos2-arthres", 2.5, "ambiguity.ratio", 2.5),
    ],
)
def test_rtklibs_names_are_understood(settings: Settings, key: str, value: object, name: str, expected: object) -> None:
    assert settings.set(key, value).changes[name][1] == expected
    assert options_of(settings.active)[name] == expected


def test_rtklibs_names_are_checked(settings: Settings) -> None:
    with pytest.raises(CommandError, match="no option type: pos1-elmas; did you mean 'pos1-elmask'"):
        settings.set("pos1-elmas", 20)
    with pytest.raises(CommandError, match="invalid option value: pos1-posmode foo"):
        settings.set("pos1-posmode", "foo")
    with pytest.raises(CommandError, match="dialect"):
        settings.set("pos1-posmode", "static", "1.0")


FULL = SolverTable(
    rover="rover",
    base="base",
    navigation=("nav",),
    mode="moving-base",
    systems="GE",
    elevation_mask_deg=7.25,
    baseline_length_m=1.03,
    excluded=("G05",),
    antex='a "quoted"\\name.atx',
    autostart=False,
    sync=SyncTable(max_wait_s=0.25, matched_only=True),
    noise=NoiseTable(phase_a_m=1e-7),
    ambiguity=AmbiguityTable(mode="fix-and-hold", hold_after_epochs=3),
    integrity=IntegrityTable(enabled=True),
)


def test_a_table_reads_back_from_its_text() -> None:
    assert parse_solver_table(toml_table("solver", FULL), "x") == FULL
    assert parse_solver_table(toml_table("solver", TABLE), "x") == TABLE


@given(st.text(max_size=30), st.floats(0.0, 90.0), st.lists(st.text(max_size=8), max_size=4), st.booleans())
def test_any_text_and_number_reads_back(text: str, mask_deg: float, excluded: list[str], single: bool) -> None:
    table = msgspec.structs.replace(
        TABLE, antex=text.replace("$", "").replace("{data}", ""), elevation_mask_deg=mask_deg,
        excluded=tuple(name.replace("$", "").replace("{data}", "") for name in excluded), autostart=single,
    )  # fmt: skip
    assert parse_solver_table(toml_table("solver", table), "x") == table


@pytest.mark.parametrize("name", ["now.toml", "now.conf"])
def test_what_is_saved_loads_back(settings: Settings, tmp_path: Path, name: str) -> None:
    settings.set("elevation_mask_deg", 12)
    settings.set("ambiguity.ratio", 2.5)
    settings.set("mode", "static")
    saved = settings.pending
    assert settings.save(name, tmp_path, overwrite=False) == (tmp_path / name).stat().st_size
    with pytest.raises(ConfigError, match="overwrite=true"):
        settings.save(name, tmp_path, overwrite=False)
    settings.set("mode", "kinematic")
    settings.set("elevation_mask_deg", 30)
    changed = settings.load(name, tmp_path)
    assert {"mode", "elevation_mask_deg"} <= set(changed.changes)
    for option in ("mode", "elevation_mask_deg", "ambiguity.ratio", "cn0_mask_dbhz", "max_age_s", "frequencies"):
        assert options_of(settings.pending)[option] == options_of(saved)[option]
    settings.save(name, tmp_path, overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == [name], "nothing is left beside it"


def test_rtklibs_file_is_read_with_the_line_of_a_fault(settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "k.conf").write_text("# a file\npos1-posmode =static  # (0:single)\ninpstr1-type =serial\npos1-elmask =10\n")
    outcome = settings.load("k.conf", tmp_path)
    assert (settings.pending.mode, settings.pending.elevation_mask_deg) == ("static", 10.0)
    assert "1 keys of streams" in outcome.note
    (tmp_path / "bad.conf").write_text("pos1-posmode =static\npos1-elmaskk =10\n")
    with pytest.raises(ConfigError, match=r"bad.conf:2: .*pos1-elmask"):
        settings.load("bad.conf", tmp_path)


class Traps:
    """A folder of configurations with all that must not be read or written."""

    def __init__(self, root: Path) -> None:
        self.folder, self.outside = root / "site", root / "outside.toml"
        (self.folder / "below").mkdir(parents=True)
        self.outside.write_text("[solver]\nrover = 'x'\n")
        (self.folder / "link.toml").symlink_to(self.outside)
        (self.folder / "out").symlink_to(root)
        (self.folder / "device.toml").symlink_to("/dev/zero")
        os.mkfifo(self.folder / "fifo.toml")
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.bind(str(self.folder / "socket.toml"))
        (self.folder / "large.toml").write_text("#" * 70000)

    names = (
        "../outside.toml", "below/../../outside.toml", "/etc/passwd", "link.toml", "out/outside.toml", "device.toml", "fifo.toml",
        "socket.toml", "below", ".hidden", "", "a\0b", "a\nb.toml", "/".join(["a"] * 40), "./x.toml", "below//x.toml", "~/x.toml",
    )  # fmt: skip


@pytest.fixture
def traps(tmp_path: Path):
    made = Traps(tmp_path)
    yield made
    made.socket.close()


@pytest.mark.parametrize("name", [*Traps.names, "large.toml", "missing.toml"])
def test_nothing_but_a_small_regular_file_below_the_folder_is_read(traps: Traps, name: str) -> None:
    """And nothing waits: a FIFO without a writer would."""
    with pytest.raises(ConfigError):
        read_below(name, traps.folder, 65536)


@pytest.mark.parametrize("name", Traps.names)
@pytest.mark.parametrize("overwrite", [False, True])
def test_nothing_but_a_regular_file_below_the_folder_is_written(traps: Traps, name: str, overwrite: bool) -> None:
    before = traps.outside.read_bytes()
    with pytest.raises(ConfigError):
        write_below(name, traps.folder, b"gone", overwrite=overwrite)
    assert traps.outside.read_bytes() == before
    assert not list(traps.folder.rglob("*new-*"))


def test_files_in_folders_below_are_read_and_written(traps: Traps) -> None:
    write_below("below/x.toml", traps.folder, b"one")
    write_below("below/x.toml", traps.folder, b"two", overwrite=True)
    assert read_below("below/x.toml", traps.folder, 10) == b"two"


def test_the_code_of_a_wrong_name_is_not_found() -> None:
    with pytest.raises(CommandError) as refusal:
        with_option(TABLE, "elmask", 1)
    assert refusal.value.code is Code.NOT_FOUND
