"""Which base a solver uses: scores out of what ingests say, fail-over with hysteresis, the process of a preset."""

import json
from math import nan
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_schemas.config import Deployment, SolverTable
from rtkmesh_schemas.config_presets import BasesTable, FilterTable, PresetTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_schemas.keys import ID
from rtkmesh_schemas.presets import PRESET_NAME, PresetType, ingest_id
from rtkmesh_schemas.status import InputStatus, ReferenceStatus, ServiceStatus, SignalStrength, State, StreamStatus
from rtkmesh_services.control.base_choice import Choice
from rtkmesh_services.control.base_ingests import base_spec, ingest_table
from rtkmesh_services.control.base_scores import score
from rtkmesh_services.control.fleet import LaunchOptions
from rtkmesh_services.control.presets import preset_of
from rtkmesh_services.runtime.configuration import Site
from rtkmesh_services.runtime.extra_ingest import INGEST_VARIABLE, with_extra_ingest

ROVER = (3783000.0, 901000.0, 5038000.0)
GOOD = {
    "frames": {},
    "epochs": 100,
    "epochs_per_s": 1.0,
    "epoch_age_s": 0.4,
    "satellites": {"G": 9, "E": 7},
    "cn0_dbhz": {"1": SignalStrength(mean=46.0, minimum=35.0, count=9)},
    "reference": ReferenceStatus(position_ecef_m=ROVER),
}


def status(*, state: State = State.RUNNING, lost: int = 0, **changed: object) -> ServiceStatus:
    stream = StreamStatus(**{**GOOD, **changed})  # pyright: ignore[reportArgumentType]
    source = InputStatus(name="tcp", state="connected", messages=1000, lost=lost, stream=stream)
    return ServiceStatus(id="base_a", role="ingest", state=state, start_id="x", heartbeat=1, inputs=[source])


def test_a_good_base_has_the_full_score() -> None:
    full = score(status(), 0.2, ROVER)
    assert full.value == 1.0
    assert full.weakest == ""
    assert full.distance_m == 0.0


@pytest.mark.parametrize(
    ("changed", "age_s", "part"),
    [
        ({}, 4.0, "age"),
        ({"epoch_age_s": 4.0}, 0.2, "age"),
        ({"epochs_per_s": 0.2}, 0.2, "rate"),
        ({"satellites": {"G": 6}}, 0.2, "satellites"),
        ({"cn0_dbhz": {"1": SignalStrength(mean=30.0, minimum=20.0, count=9)}}, 0.2, "cn0"),
        ({"reference": None}, 0.2, "position"),
        ({"reference": ReferenceStatus(position_ecef_m=(ROVER[0] + 5e4, *ROVER[1:]))}, 0.2, "distance"),
        ({"checksum_failures": {"rtcm3": 100}}, 0.2, "errors"),
    ],
)
def test_each_weakness_costs_and_is_named(changed: dict[str, object], age_s: float, part: str) -> None:
    weak = score(status(**changed), age_s, ROVER)
    assert 0.0 < weak.value < 0.8
    assert weak.weakest == part


@pytest.mark.parametrize("changed", [{"epoch_age_s": None}, {"epoch_age_s": 20.0}, {"state": State.FAILED}, {"satellites": {"G": 3}}])
def test_what_is_of_no_use_has_no_score(changed: dict[str, object]) -> None:
    assert score(status(**changed), 0.2, ROVER).value == 0.0  # pyright: ignore[reportArgumentType]
    assert score(None, 0.0).value == 0.0


@given(st.floats(0.0, 1e6), st.floats(0.0, 100.0), st.integers(0, 100), st.floats(-10.0, 100.0), st.integers(0, 10**9), st.floats(0.0, 1e7))
def test_a_score_is_a_number_from_0_to_1_whatever_is_said(age: float, rate: float, count: int, cn0: float, lost: int, far: float) -> None:
    said = status(
        epoch_age_s=age, epochs_per_s=rate, satellites={"G": count}, cn0_dbhz={"1": SignalStrength(mean=cn0, minimum=cn0, count=1)},
        reference=ReferenceStatus(position_ecef_m=(ROVER[0] + far, *ROVER[1:])), lost=lost,
    )  # fmt: skip
    assert 0.0 <= score(said, 0.0, ROVER).value <= 1.0


LIMITS = BasesTable(failover_after_s=5.0, return_after_s=30.0, timeout_s=15.0)


def choice(*names: str) -> Choice:
    made = Choice(LIMITS, names)
    made.prefer(names[0] if names else "x", 0.0)
    return made


def play(made: Choice, scores: dict[str, float], begin_s: float, end_s: float) -> list[float]:
    """Let time pass with constant scores; return when another base was taken."""
    taken, now_s = [], begin_s
    while now_s < end_s:
        if made.update(scores, now_s):
            taken.append(now_s)
        now_s += 0.5
    return taken


def test_a_silent_base_is_left_after_its_time_and_taken_again_when_it_has_been_good_for_long() -> None:
    made = choice("a", "b", "c")
    assert play(made, {"a": 0.9, "b": 0.9}, 0.0, 20.0) == []
    assert made.wanted == ("a",)
    assert play(made, {"a": 0.0, "b": 0.0, "c": 0.8}, 20.0, 24.0) == []
    assert play(made, {"a": 0.0, "b": 0.0, "c": 0.8}, 24.0, 40.0) == [25.0]
    assert made.active == "c"
    assert made.wanted == ("a", "b", "c")
    assert play(made, {"a": 0.9, "b": 0.0, "c": 0.8}, 40.0, 69.5) == []
    assert play(made, {"a": 0.9, "b": 0.0, "c": 0.8}, 69.5, 75.0) == [70.0]
    assert made.active == "a"
    play(made, {"a": 0.9}, 75.0, 76.0)
    assert made.wanted == ("a",)


def test_a_base_that_flickers_is_neither_left_nor_taken_back() -> None:
    made = choice("a", "b")
    for second in range(0, 60, 4):
        assert play(made, {"a": 0.9 if second % 8 else 0.1, "b": 0.9}, second, second + 4) == []
    play(made, {"a": 0.0, "b": 0.9}, 60.0, 70.0)
    assert made.active == "b"
    for second in range(70, 200, 20):
        assert play(made, {"a": 0.9, "b": 0.9}, second, second + 18) == []
        assert play(made, {"a": 0.3, "b": 0.9}, second + 18, second + 20) == []  # between bad and good: not good


def test_a_base_that_was_just_selected_has_the_time_out_to_deliver() -> None:
    made = choice("a", "b")
    assert play(made, {"a": 0.0, "b": 0.9}, 0.0, 14.5) == []
    assert play(made, {"a": 0.0, "b": 0.9}, 14.5, 20.0) == [15.0]


def test_a_process_that_still_starts_has_its_time_from_its_first_status_on() -> None:
    made = choice("a", "b")
    made.prefer("a", 0.0, starting=True)
    assert play(made, {"b": 0.9}, 0.0, 25.0) == []
    made.started("b", 20.0)  # that of another one
    made.started("a", 25.0)
    assert play(made, {"b": 0.9}, 25.0, 39.5) == []
    assert play(made, {"b": 0.9}, 39.5, 45.0) == [40.0]
    made.prefer("a", 50.0, starting=True)
    assert play(made, {"b": 0.9}, 50.0, 94.5) == []  # one that never says anything is left as well
    assert play(made, {"b": 0.9}, 94.5, 100.0) == [95.0]


def test_when_all_are_bad_the_present_one_stays_and_all_are_tried() -> None:
    made = choice("a", "b")
    assert play(made, {}, 0.0, 100.0) == []
    assert made.active == "a"
    assert made.wanted == ("a", "b")
    made.prefer(None, 100.0)
    assert (made.active, made.wanted, made.update({}, 101.0)) == (None, (), "")


@given(st.text(st.characters(codec="ascii"), min_size=1, max_size=64))
def test_every_preset_has_a_process_of_its_own(name: str) -> None:
    if PRESET_NAME.fullmatch(name):
        assert ID.fullmatch(ingest_id(name))
        assert ingest_id(name) != ingest_id(f"{name[:63]}-") or name.endswith("-")


def test_ids_that_differ_by_case_or_signs_only_have_processes_of_their_own() -> None:
    names = ["near", "Near", "near-", "n_ear", "n-ear", "-dev-ttyACM0-0", "dev-ttyACM0-0", "a" * 64, "a" * 63]
    assert len({ingest_id(name) for name in names}) == len(names)
    assert ingest_id("near") == "base_near"


def test_the_process_of_a_preset_is_told_its_table_and_knows_whose_base_it_is(tmp_path: Path) -> None:
    table = PresetTable(
        sources=("ntrip://u:secret@caster:2101/M", "tcp://a:1"), format="rtcm3", filter=FilterTable(reject=("rtcm3/1230",)),
        position_llh_deg=(52.0, 13.0, 100.0), init=("!HEX 00",),
    )  # fmt: skip
    deployment = Deployment(
        solver={"rtk": SolverTable(rover="r", base="b"), "vector": SolverTable(rover="r", base="r2", mode="moving-base")}
    )
    spec = base_spec(preset_of("Roof", table, PresetType.USER), deployment, LaunchOptions(tmp_path / "site.toml"))
    assert "secret" not in " ".join(spec.argv)  # it would be in `ps`
    assert json.loads(spec.environment[INGEST_VARIABLE])["source"] == table.sources[0]
    site = with_extra_ingest(Site(deployment=deployment, file=Path(), folder=Path(), hash="", data_folder=None), spec.id, spec.environment)
    made = site.deployment.ingest[spec.id]
    assert (made.source, made.fallback) == (table.sources[0], ("tcp://a:1",))
    assert made.filter.reject == ("rtcm3/1230",)
    assert made.commands.start == ("!HEX 00",)
    assert made.position_llh_deg == (52.0, 13.0, 100.0)
    assert site.deployment.solver["rtk"].base == spec.id
    assert site.deployment.solver["vector"].base == "r2"
    with pytest.raises(ConfigError, match="no table of an ingest"):
        with_extra_ingest(site, spec.id, {INGEST_VARIABLE: '{"source": 7}'})


@pytest.mark.parametrize(
    ("source", "position", "mode"),
    [
        ("serial:///dev/ttyACM0", None, "survey-in"),
        ("tcp://a:1", None, "survey-in"),
        ("ntrip://a:1/M", None, ""),
        ("serial:///dev/ttyACM0", (1.0, 2.0, 3.0), ""),
    ],
)
def test_auto_survey_asks_the_receivers_that_can_be_asked(source: str, position: tuple[float, float, float] | None, mode: str) -> None:
    preset = preset_of("a", PresetTable(sources=(source,), auto_survey=True, position_llh_deg=position), PresetType.DYNAMIC)
    station = ingest_table(preset, BasesTable(survey_s=120.0)).base_station
    assert ("" if station is None else station.mode) == mode
    assert station is None or station.minimum_s == 120.0


def test_scores_that_are_no_numbers_do_not_upset_a_choice() -> None:
    made = choice("a", "b")
    assert play(made, {"a": nan, "b": 0.9}, 0.0, 40.0) == []
