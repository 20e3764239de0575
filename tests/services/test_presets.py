"""The book of base stations: what there is, what users make of it, what is selected, and what of it is kept."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from serial.tools.list_ports_common import ListPortInfo

from rtkmesh_schemas.config_presets import BasesTable, PresetTable
from rtkmesh_schemas.presets import PresetType
from rtkmesh_services.cli.check import url_errors
from rtkmesh_services.control.preset_fields import PresetError
from rtkmesh_services.control.preset_ports import find_ports, port_id
from rtkmesh_services.control.presets import BACK_S, Change, PresetBook
from rtkmesh_services.runtime.configuration import ConfigErrors, parse_deployment

BUILTIN = {"near": PresetTable(sources=("tcp://127.0.0.1:1",)), "far": PresetTable(sources=("tcp://127.0.0.1:2",), title="Far away")}


@dataclass
class Book:
    """A book in a folder, with a clock of our own; ``told`` is what a listener heard."""

    folder: Path | None = None
    builtin: Mapping[str, PresetTable] = field(default_factory=lambda: BUILTIN)
    now_s: float = 1000.0
    told: list[tuple[str, str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.book = PresetBook(self.builtin, self.folder, lambda: self.now_s)
        self.book.on_change(lambda change, id_, solver: self.told.append((change.value, id_, solver)))


def plugged(device: str, vid: int = 0x1546, pid: int = 0x01A9, product: str = "u-blox") -> ListPortInfo:
    info = ListPortInfo(device)
    info.vid, info.pid, info.product = vid, pid, product
    return info


def test_presets_come_in_the_order_of_registration_with_their_title() -> None:
    book = Book().book
    id_ = book.new({"source": "ntrip://u:p@caster:2101/M", "title": "Mine"})
    assert book.ids() == ["near", "far", id_]
    assert [book.get(name).title for name in book.ids()] == ["near", "Far away", "Mine"]
    assert [book.get(name).type for name in book.ids()] == [PresetType.BUILTIN, PresetType.BUILTIN, PresetType.USER]
    assert book.get("nope") is None


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({}, "sources"),
        ({"source": "tcp://a:1", "id": "x"}, "Preset must not have an ID"),
        ({"source": "tcp://a:1", "type": "user"}, "Preset must not have a type"),
        ({"source": "tcp://a:1", "format": "foo"}, "Invalid RTK packet format: 'foo'"),
        ({"source": "tcp://a:1", "titel": "x"}, "did you mean 'title'"),
        ({"source": "tpc://a:1"}, "did you mean 'tcp'"),
        ({"source": "file:///x"}, "no base station"),
        ({"source": 7}, "Preset does not match expected schema"),
        ({"sources": []}, "Preset does not match expected schema"),
        ({"source": "tcp://a:1", "filter": {"accept": ["1077"]}}, "Preset does not match expected schema"),
        ({"source": "tcp://a:1", "position_ecef_m": [1.0, 2.0, float("nan")]}, "Preset does not match expected schema"),
        ({"source": "tcp://a:1", "position_ecef_m": [1e6, 2e6, 6e6], "position_llh_deg": [1.0, 2.0, 3.0]}, "two positions"),
    ],
)
def test_a_preset_that_is_none_is_refused_with_the_reason(fields: dict[str, Any], text: str) -> None:
    kept = Book()
    with pytest.raises(PresetError, match=text):
        kept.book.new(fields)
    assert kept.book.ids() == ["near", "far"]
    assert kept.told == []


def test_only_presets_of_users_are_changed_and_deleted() -> None:
    kept = Book()
    book = kept.book
    mine = book.new({"sources": ["tcp://a:1"], "filter": {"accept": ["rtcm3/1077"]}}, "mine")
    assert mine == "mine"
    book.update("mine", {"title": "New", "filter": None})
    assert (book.get("mine").title, book.get("mine").accept) == ("New", ())
    for act in (lambda: book.update("near", {"title": "x"}), lambda: book.delete("near")):
        with pytest.raises(PresetError, match="Only user-defined presets can be deleted"):
            act()
    with pytest.raises(PresetError, match="No such RTK preset"):
        book.delete("nope")
    with pytest.raises(PresetError, match="already"):
        book.new({"sources": ["tcp://a:1"]}, "near")
    with pytest.raises(PresetError, match="no preset's name"):
        book.new({"sources": ["tcp://a:1"]}, "a/b")
    book.select("mine")
    book.delete("mine")
    assert book.selected() is None
    assert kept.told[-1] == (Change.LOST, "mine", "")


def test_selection_for_the_fleet_and_for_a_solver() -> None:
    kept = Book()
    book = kept.book
    assert book.selected() is None
    book.select("near")
    book.select("far", "rtk")
    assert (book.selected(), book.selected("rtk"), book.selected("other")) == ("near", "far", "near")
    book.select(None, "rtk")
    assert (book.selected(), book.selected("rtk")) == ("near", None)
    book.follow_fleet("rtk")
    assert book.selected("rtk") == "near"
    book.select("far", "rtk")
    book.select("near")  # for the fleet: all
    assert book.selected("rtk") == "near"
    with pytest.raises(PresetError, match="No such RTK preset"):
        book.select("nope")
    assert kept.told[0] == ("selected", "near", "")


def test_the_selection_and_saved_presets_are_there_after_a_restart(tmp_path: Path) -> None:
    book = Book(tmp_path).book
    saved = book.new({"source": "tcp://a:1"})
    book.save()
    unsaved = book.new({"source": "tcp://a:2"})
    book.select("far")
    book.select(saved, "rtk")
    again = Book(tmp_path).book
    assert again.ids() == ["near", "far", saved]
    assert (again.selected(), again.selected("rtk")) == ("far", saved)
    assert unsaved not in again.ids()
    again.select(None)
    assert Book(tmp_path, {"far": PresetTable(sources=("tcp://b:1",), auto_select=True)}).book.selected() is None


@pytest.mark.parametrize("content", ["", "[]", '{"presets": 7}', '{"fleet": ["x"], "solvers": 3}', "\x00" * 50])
def test_kept_files_that_are_none_cost_nothing_but_their_content(tmp_path: Path, content: str) -> None:
    for name in ("presets.json", "preset_selection.json"):
        (tmp_path / name).write_text(content)
    book = Book(tmp_path).book
    assert book.ids() == ["near", "far"]
    book.select("near")
    assert Book(tmp_path).book.selected() == "near"


def test_the_first_preset_with_auto_select_is_selected_at_the_first_start(tmp_path: Path) -> None:
    builtin = {**BUILTIN, "auto": PresetTable(sources=("tcp://a:1",), auto_select=True)}
    assert Book(tmp_path, builtin).book.selected() == "auto"
    assert not (tmp_path / "preset_selection.json").exists()


def test_rtcm_2_is_not_selected_as_it_is_not_decoded() -> None:
    book = Book(None, {"old": PresetTable(sources=("tcp://a:1",), format="rtcm2")}).book
    with pytest.raises(PresetError, match="RTCM 2 is not decoded"):
        book.select("old")


def test_serial_ports_become_presets_but_for_autopilots_and_what_is_excluded() -> None:
    there = [
        plugged("/dev/ttyACM0"),
        plugged("/dev/ttyACM1", 0x26AC, 0x0011, "PX4 FMU"),
        plugged("/dev/ttyUSB0", 0x0403, 0x6015, "FTDI radio"),
        plugged("/dev/ttyUSB1", 0x10C4, 0xEA60, "CP2102"),
        ListPortInfo("/dev/ttyS0"),
    ]
    bases = BasesTable(bauds=(115200, 460800), exclude=("*radio*",))
    found = find_ports(bases, ["/dev/ttyUSB1"], there)
    assert list(found) == ["-dev-ttyACM0-0", "-dev-ttyACM0-1"]
    assert [port.table.sources for port in found.values()] == [
        ("serial:///dev/ttyACM0?baud=115200",),
        ("serial:///dev/ttyACM0?baud=460800",),
    ]
    assert all(port.table.auto_survey for port in found.values())
    assert port_id("COM3", 0) == "COM3-0"


def test_a_selected_port_that_vanishes_is_selected_again_only_within_thirty_seconds_of_the_choice() -> None:
    kept = Book()
    book = kept.book
    ports = find_ports(BasesTable(), (), [plugged("/dev/ttyACM0")])
    book.ports(ports)
    [id_] = ports
    assert book.ids()[-1] == id_
    book.select(id_)
    kept.now_s += BACK_S - 10.0
    book.ports({})
    assert book.selected() is None
    assert kept.told[-1] == ("lost", id_, "")
    kept.now_s += 9.0
    book.ports(ports)
    assert book.selected() == id_
    assert kept.told[-1] == ("back", id_, "")
    kept.now_s += 5.0
    book.ports({})
    book.ports(ports)
    assert book.selected() is None


def test_another_choice_meanwhile_is_not_overruled_by_the_port_that_is_back() -> None:
    kept = Book()
    ports = find_ports(BasesTable(), (), [plugged("/dev/ttyACM0")])
    kept.book.ports(ports)
    kept.book.select(next(iter(ports)))
    kept.book.ports({})
    kept.book.select("near")
    kept.book.ports(ports)
    assert kept.book.selected() == "near"


def test_a_file_that_is_read_again_changes_its_presets_and_no_others() -> None:
    book = Book().book
    mine = book.new({"source": "tcp://a:1"})
    book.select("far")
    book.replace_builtin({"near": PresetTable(sources=("tcp://c:3",))})
    assert book.ids() == ["near", mine]
    assert book.get("near").sources == ("tcp://c:3",)
    assert book.selected() is None


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('[preset.a]\nsources = ["tcp://a:1"]\nstandbye = true', "did you mean 'standby'"),
        ('[preset."a b"]\nsources = ["tcp://a:1"]', "no preset's name"),
        ('[preset.a]\nsources = ["ntip://a:1/M"]', "did you mean 'ntrip'"),
        ('[preset.a]\nsources = ["file:///x.ubx"]', "no base station"),
        ("[preset.a]\nsources = []", "sources"),
        (
            '[preset.a]\nsources = ["tcp://a:1"]\n[ingest.r]\nsource = "tcp://r:1"\n[solver.s]\nrover = "r"\npresets = ["b"]',
            "no [preset.b]",
        ),
        ('[preset.a]\nsources = ["tcp://a:1"]\n[preset.a.filter]\naccept = ["1077"]', "accept"),
        ('[ingest.r]\nsource = "tcp://r:1"\n[solver.s]\nrover = "r"', "has no 'base'"),
    ],
)
def test_faults_of_the_file_are_named_with_their_line(text: str, expected: str) -> None:
    with pytest.raises(ConfigErrors) as caught:
        parse_deployment(text, "site.toml")
    assert expected in str(caught.value)
    assert all(error.line for error in caught.value.errors)


def test_a_solver_needs_no_base_where_there_are_presets() -> None:
    text = '[preset.a]\nsources = ["tcp://a:1"]\n[ingest.r]\nsource = "tcp://r:1"\n[solver.s]\nrover = "r"\npresets = ["a"]'
    assert parse_deployment(text, "site.toml").solver["s"].presets == ("a",)


@pytest.mark.parametrize(
    ("lines", "line", "text"),
    [
        ('sources = ["tcp://a:1", "ntrip://a:1"]', 2, "says no mount point"),
        ('sources = ["serial:///dev/ttyACM0?bawd=1"]', 2, "did you mean 'baud'"),
        ('sources = ["sim://two_bases/base3"]', 2, "base2"),
        ('sources = ["tcp://a:1"]\nantenna = "NONSENSE"', 3, "NONSENSE"),
    ],
)
def test_check_looks_at_the_sources_of_presets(tmp_path: Path, lines: str, line: int, text: str) -> None:
    file = tmp_path / "site.toml"
    file.write_text(f"[preset.a]\n{lines}\n")
    [error] = url_errors(file, parse_deployment(file.read_text(), str(file)), simulations=True)
    assert error.line == line
    assert text in str(error)
