"""The commands to presets, and what they answer to what is wrong: nothing asks back, nothing raises, passwords stay here."""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_schemas.command import Code
from rtkmesh_schemas.config_presets import PresetTable
from rtkmesh_schemas.presets import Preset
from rtkmesh_schemas.wire import MAXIMUM_BYTES, encode_json
from rtkmesh_services.control.base_words import TOLD, PresetDesk
from rtkmesh_services.control.presets import PresetBook
from rtkmesh_services.errors import CommandError

BUILTIN = {"near": PresetTable(sources=("ntrip://user:secret@caster:2101/NEAR",)), "far": PresetTable(sources=("tcp://a:1",))}


class Teller:
    """Two solvers; no preset runs."""

    def solvers(self) -> list[str]:
        return ["rtk", "other"]

    def state_of(self, preset: Preset) -> Mapping[str, Any]:
        return {"state": "", "score": 0.0, "preset": preset.id}


def desk() -> PresetDesk:
    return PresetDesk(PresetBook(BUILTIN), Teller())


def test_the_list_tells_all_without_passwords() -> None:
    made = desk()
    made.act("select", {"id": "near"})
    made.act("select", {"id": "far", "solver": "rtk"})
    data = made.act("list", {}).data
    assert (data["selected"], data["solvers"]) == ("near", {"rtk": "far"})
    assert [preset["id"] for preset in data["presets"]] == ["near", "far"]
    assert "secret" not in str(data)
    assert made.act("show", {"id": "far"}).data["preset"]["ingest"] == "base_far"


def test_many_presets_are_told_in_answers_that_fit_into_messages() -> None:
    made = desk()
    for number in range(150):
        made.act("new", {"id": f"user{number}", "source": f"ntrip://user:secret@caster:2101/{'M' * 300}", "title": "x" * 200})
    first, found = 0, []
    while True:
        reply = made.act("list", {"first": first})
        assert len(encode_json(reply)) < MAXIMUM_BYTES
        found += [preset["id"] for preset in reply.data["presets"]]
        if "next" not in reply.data:
            break
        first = reply.data["next"]
        assert first % TOLD == 0
    assert len(found) == len(set(found)) == 152


@pytest.mark.parametrize(
    ("action", "arguments", "code", "text"),
    [
        ("selct", {}, Code.BAD_ARGUMENTS, "did you mean 'select'"),
        ("select", {"id": "neer"}, Code.NOT_FOUND, "No such RTK preset 'neer'; did you mean 'near'"),
        ("select", {"id": "near", "solver": "rtc"}, Code.NOT_FOUND, "did you mean 'rtk'"),
        ("show", {}, Code.NOT_FOUND, "No such RTK preset"),
        ("follow", {}, Code.BAD_ARGUMENTS, "solver=SOLVER"),
        ("delete", {"id": "near"}, Code.NOT_ALLOWED, "Only user-defined"),
        ("update", {"id": "far", "fields": {"title": "x"}}, Code.NOT_ALLOWED, "Only user-defined"),
        ("new", {"id": "x", "fields": {}}, Code.BAD_ARGUMENTS, "sources"),
        ("list", {"first": -1}, Code.BAD_ARGUMENTS, "first"),
    ],
)
def test_what_is_wrong_is_said_with_the_nearest_right_name(action: str, arguments: dict[str, Any], code: Code, text: str) -> None:
    with pytest.raises(CommandError) as caught:
        desk().act(action, arguments)
    assert caught.value.code is code
    assert text in str(caught.value)


def test_select_follow_and_none() -> None:
    made = desk()
    assert made.act("select", {"id": "near"}).code is Code.ACCEPTED
    made.act("select", {"id": "", "solver": "rtk"})
    assert made.act("list", {}).data["solvers"] == {"rtk": None}
    assert made.act("follow", {"solver": "rtk"}).data["selected"] == "near"
    assert made.act("select", {}).data["selected"] is None


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
)
ACTIONS = st.sampled_from(["list", "show", "select", "follow", "new", "update", "delete", "save", "x"])
NAMES = st.sampled_from(["id", "name", "solver", "fields", "first", "sources", "source", "title", "filter", "init", "format", "antenna"])


@given(ACTIONS, st.dictionaries(NAMES, PLAIN, max_size=5))
def test_no_argument_whatever_raises_anything_but_a_refusal(action: str, arguments: dict[str, Any]) -> None:
    with suppress(CommandError):
        assert desk().act(action, arguments).ok
