"""The page of keys is the table's; the table has what RTKLIB's own programs have."""

import re
from pathlib import Path

import pytest

from rtkmesh_services.conf.choices import DIALECTS
from rtkmesh_services.conf.reference import conf_keys_page, counts
from rtkmesh_services.conf.rows import Fate
from rtkmesh_services.conf.table import ALL_ROWS, SYSTEM_ROWS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "conf_keys.md"


def test_the_page_is_current():
    """`rtkmesh conf keys --write docs/reference/conf_keys.md` makes it anew."""
    assert PAGE.read_text() == conf_keys_page()


def test_every_key_that_is_ignored_has_a_reason_and_every_other_a_place():
    """Or a word of how it is done anyway."""
    for row in ALL_ROWS.values():
        assert row.why if row.fate is Fate.IGNORED else row.target or row.why, row.name


def test_the_numbers_of_keys():
    """128 system keys in demo5 (reference: RTKLIB EX 2.5.1), 112 in 2.4.3 b34; counted by name."""
    assert sum(row.known_to("demo5") for row in SYSTEM_ROWS) == 128
    assert sum(row.known_to("2.4") for row in SYSTEM_ROWS) == 112
    assert {dialect: count.total() for dialect, count in counts().items()} == {"demo5": 173, "2.4": 154}
    assert set(counts()) == set(DIALECTS)


def test_names_lists_and_defaults_are_those_of_demo5(tmp_path: Path):
    """What pyrtklib5 (demo5 2.5.0) saves after a reset: the same keys in the same order, the same enumerations and defaults."""
    rtklib = pytest.importorskip("pyrtklib5")
    rtklib.resetsysopts()
    saved = tmp_path / "saved.conf"
    assert rtklib.saveopts(str(saved), "w", "", rtklib.sysopts.ptr) == 1
    found = re.findall(r"(?m)^([a-z0-9]+-[A-Za-z0-9_]+) *=([^#\n]*)(?:# \((.*)\))?$", saved.read_text())
    rows = [row for row in SYSTEM_ROWS if row.known_to("demo5") and row.name != "pos2-rejphase"]  # 2.5.1's
    assert [name for name, _, _ in found] == [row.name for row in rows]
    for row, (_, value, listed) in zip(rows, found, strict=True):
        if row.choices is not None and row.choices.demo5:
            assert ",".join(f"{number}:{name}" for name, number in row.choices.demo5.items()) == listed
        if row.name != "pos1-navsys" and not row.name.startswith("pos1-snrmask_L"):  # built without BeiDou; masks are left empty
            assert value.strip() == row.default, row.name
