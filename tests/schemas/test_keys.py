"""The table of streams and its page."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_schemas import reference
from rtkmesh_schemas.errors import BadKeyError
from rtkmesh_schemas.keys import BY_NAME, EPH, LIVE, RAW, SOL, SOL_TEXT, STREAMS, Kind, Role, check_id, live_key, stream_of

REFERENCE = Path(__file__).resolve().parents[2] / "docs" / "reference"


def test_every_key_leads_back_to_its_stream_and_owner():
    """A concrete key names one row of the table and one process, for every row."""
    for stream in STREAMS:
        names = ("protocol", "satellite", "format", "level", "name", "role", "output", "word")
        fields = {name: "x1" for name in names if f"{{{name}}}" in stream.template}
        found = stream_of(stream.key("rover_1", **fields))
        assert found is not None
        assert found[0] is stream
        assert found[1] == ("rover_1" if "{id}" in stream.template else "control")


def test_names_are_unique_and_cached_streams_have_a_depth():
    """The table's names are keys of its index; cached streams keep something."""
    assert len(BY_NAME) == len(STREAMS)
    assert all((stream.cache > 0) == (stream.kind is Kind.CACHED) for stream in STREAMS)


def test_all_messages_of_one_receiver_share_one_priority():
    """Zenoh keeps order only within a priority: what must stay in stream order has the same one."""
    assert len({BY_NAME[name].priority for name in ("obs", "eph", "iono", "ref", "end")}) == 1


def test_expressions_match_all_processes():
    """A template's expression has a star for each field."""
    assert SOL.expression() == "rtk/*/sol"
    assert EPH.expression() == "rtk/*/eph/*"
    assert LIVE.expression() == "rtk/@live/*/*"
    assert SOL_TEXT.key("a", format="llh") == "rtk/a/sol/llh"
    assert RAW.key("a", protocol="ubx") == "rtk/a/raw/ubx"
    assert live_key(Role.SOLVER, "a") == "rtk/@live/solver/a"


@given(st.text(alphabet="abz09_", min_size=1, max_size=64))
def test_ids_of_the_alphabet_pass(name: str):
    """Ids are of a-z, 0-9 and _."""
    assert check_id(name) == name


@pytest.mark.parametrize("name", ["", "A", "a/b", "a b", "ä", "a" * 65, "**", "a*", "flockwave", "@live", "a\n", "a?x"])
def test_other_ids_are_refused(name: str):
    """Nothing that could be another key, a wildcard or a reserved chunk is an id."""
    with pytest.raises(BadKeyError):
        check_id(name)


def test_unknown_keys_are_no_stream():
    """A foreign key is no row of the table."""
    assert stream_of("rtk/a/b/c/d") is None
    assert stream_of("other/a/sol") is None


@pytest.mark.parametrize("page", sorted(reference.reference_pages()))
def test_the_reference_is_what_the_code_says(page: str):
    """docs/reference is generated; ``rtkmesh schema --write docs/reference`` brings it up to date."""
    assert (REFERENCE / page).read_text() == reference.reference_pages()[page]


def test_the_reference_has_no_page_of_something_that_is_gone():
    """No schema of a removed message lies about."""
    assert {f"schemas/{path.name}" for path in (REFERENCE / "schemas").iterdir()} == set(reference.reference_pages()) - {"keys.md"}


def test_every_message_of_the_table_has_a_schema():
    """What the table names exists."""
    assert {stream.type for stream in STREAMS if stream.type} <= set(reference.MESSAGES)
