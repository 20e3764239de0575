"""Known places choose integers in the attitude process on an in-memory bus: when, what comes of it, what is late, and what is wrong."""

from itertools import permutations
from math import degrees, isnan, nan
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.services.attitude_body import ANGLES_RAD, SQUARE, Vehicle

from rtkmesh.attitude.rotation import NED_FROM_ENU, rotation_of_angles
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.config_attitude import AttitudeTable
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_services.mapping.candidates import candidates_of

FLOAT = {"status": 2, "status_name": "FLOAT", "reason": "ratio", "candidates": True}
TRIANGLES = ("ab", "ac", "ad", "bc", "bd", "cd")


def floating(vehicle: Vehicle, name: str, tow_s: float) -> SolutionMessage:
    """A baseline that is not fixed, and off by decimetres."""
    return vehicle.baseline(name, tow_s, (0.4, -0.3, 0.2), **FLOAT)


def is_right(message: AttitudeMessage) -> bool:
    angles = (message.heading_rad, message.pitch_rad, message.roll_rad)
    return all(abs(angle - true) < 1e-4 for angle, true in zip(angles, ANGLES_RAD, strict=True))


def test_floats_become_an_attitude() -> None:
    """No baseline is fixed, and the second best norm of each is the right one: only the shape can know."""
    vehicle = Vehicle()
    for name in vehicle.baselines:
        vehicle.say(name, floating(vehicle, name, 10.0))
        vehicle.say(name, vehicle.candidates(name, 10.0))
    [message] = vehicle.attitudes()
    assert is_right(message)
    assert (message.integrity, message.status_name, message.geometry) == ("ok", "FIX", "accepted")
    assert message.sources == dict.fromkeys(vehicle.baselines, "geometry")
    assert 0.0 < message.geometry_wrong_probability < 0.01
    assert vehicle.service.report().counters["geometry_accepted"] == 1


def test_the_order_of_solutions_and_candidates_changes_nothing() -> None:
    """All orders of two solutions and their candidates give the same bits, once."""
    found = []
    for order in permutations((name, what) for name in ("ab", "ac") for what in ("sol", "candidates")):
        vehicle = Vehicle({name: SQUARE[name] for name in "abc"})
        for index, (name, what) in enumerate(order):
            assert not vehicle.attitudes(), (order, index)
            vehicle.say(name, floating(vehicle, name, 10.0) if what == "sol" else vehicle.candidates(name, 10.0))
        [message] = vehicle.attitudes()
        found.append(msgspec.structs.replace(message, start_id="", published_mono_ns=0))
    assert is_right(found[0])
    assert len({msgspec.msgpack.encode(message) for message in found}) == 1


def test_fixes_that_agree_do_not_wait_for_candidates() -> None:
    """A star of fixed baselines has no triangle: there is nothing that candidates could change."""
    vehicle = Vehicle()
    for name in vehicle.baselines:
        vehicle.say(name, vehicle.baseline(name, 10.0, candidates=True))
    [message] = vehicle.attitudes()
    assert (message.integrity, message.geometry, set(message.sources.values())) == ("ok", "", {"baseline"})
    for name in vehicle.baselines:
        vehicle.say(name, vehicle.candidates(name, 10.0))
    assert len(vehicle.attitudes()) == 1
    assert "late_candidates" not in vehicle.service.report().counters


def test_one_float_among_fixes_is_chosen_and_they_stay() -> None:
    vehicle = Vehicle()
    for name in vehicle.baselines:
        vehicle.say(name, floating(vehicle, name, 10.0) if name == "ac" else vehicle.baseline(name, 10.0, candidates=True))
        vehicle.say(name, vehicle.candidates(name, 10.0))
    [message] = vehicle.attitudes()
    assert is_right(message)
    assert message.sources == {"ab": "baseline", "ac": "geometry", "ad": "baseline"}


def test_a_fix_that_contradicts_the_shape_is_overruled() -> None:
    """Three antennas find a fault and cannot say whose it is; their candidates can."""
    vehicle = Vehicle({name: SQUARE[name] for name in "abc"})
    for name in vehicle.baselines:
        vehicle.say(name, wrong_fix(vehicle, name, 10.0) if name == "ac" else vehicle.baseline(name, 10.0, candidates=True))
        vehicle.say(name, vehicle.candidates(name, 10.0))
    [message] = vehicle.attitudes()
    assert is_right(message)
    assert (message.integrity, message.sources) == ("ok", {"ab": "baseline", "ac": "geometry"})
    assert "ac was fixed elsewhere" in message.reason
    assert vehicle.service.report().counters["fixes_overruled"] == 1


def wrong_fix(vehicle: Vehicle, name: str, tow_s: float) -> SolutionMessage:
    """A fix with the integers of the first wrong candidate."""
    start, end = vehicle.baselines[name]
    true = rotation_of_angles(*ANGLES_RAD) @ (vehicle.places[end] - vehicle.places[start])
    wrong = candidates_of(vehicle.candidates(name, tow_s, right=False), 0, 1).baselines_ned_m[0]
    return vehicle.baseline(name, tow_s, (NED_FROM_ENU @ (wrong - true)).tolist(), candidates=True)


def test_candidates_that_come_too_late_are_counted_and_change_nothing() -> None:
    """The deadline holds: the epoch goes out without them."""
    vehicle = Vehicle({name: SQUARE[name] for name in "abc"}, wait_s=0.2)
    for name in vehicle.baselines:
        vehicle.say(name, floating(vehicle, name, 10.0))
    vehicle.say("ab", vehicle.candidates("ab", 10.0))
    vehicle.step(0.15)
    assert not vehicle.attitudes()
    vehicle.step(0.06)
    [message] = vehicle.attitudes()
    assert (message.integrity, isnan(message.heading_rad)) == ("unavailable", True)
    vehicle.say("ac", vehicle.candidates("ac", 10.0))
    assert len(vehicle.attitudes()) == 1
    report = vehicle.service.report()
    assert (report.counters["late_candidates"], report.counters["deadlines"]) == (1, 1)
    assert {row.name: row.counters for row in report.inputs}["ac"] == {"late_candidates": 1}


def test_candidates_of_a_later_epoch_end_the_wait() -> None:
    """They come in order: what was lost on the way is not waited for."""
    vehicle = Vehicle({name: SQUARE[name] for name in "ab"})
    vehicle.say("ab", floating(vehicle, "ab", 10.0))
    vehicle.say("ab", vehicle.candidates("ab", 11.0, wrong_norm=20.0))
    assert len(vehicle.attitudes()) == 1
    vehicle.say("ab", floating(vehicle, "ab", 11.0))
    assert [message.geometry for message in vehicle.attitudes()] == ["no candidates", "accepted"]


def test_what_is_not_sure_is_not_taken() -> None:
    """No candidate is right, or none is there: no attitude, and the reason."""
    for told in ({"right": False}, {"right_norm": 90.0}, {"norms": [], "integers": [], "baselines_ecef_m": []}):
        vehicle = Vehicle()
        for name in vehicle.baselines:
            vehicle.say(name, floating(vehicle, name, 10.0))
            vehicle.say(name, vehicle.candidates(name, 10.0, **told))
        [message] = vehicle.attitudes()
        assert (message.integrity, isnan(message.heading_rad), message.sources) == ("unavailable", True, {})
        assert message.geometry not in ("", "accepted")


def test_an_antenna_without_a_right_candidate_is_left_out() -> None:
    """No combination of all fits: three antennas give the attitude, and what became of the fourth is said."""
    vehicle = Vehicle()
    for name in vehicle.baselines:
        vehicle.say(name, floating(vehicle, name, 10.0))
        vehicle.say(name, vehicle.candidates(name, 10.0, right=name != "ad"))
    [message] = vehicle.attitudes()
    assert is_right(message)
    assert (message.integrity, message.geometry) == ("ok", "accepted")
    assert message.sources == {"ab": "geometry", "ac": "geometry"}
    assert message.antennas_used == ["a", "b", "c"]
    assert message.sources_missing == {"ad": "integers of ad do not fit with the others"}
    assert 0.0 < message.geometry_wrong_probability < 0.01
    assert vehicle.service.report().counters["geometry_without_one"] == 1


def test_it_can_be_switched_off() -> None:
    vehicle = Vehicle(geometry=False)
    for name in vehicle.baselines:
        vehicle.say(name, floating(vehicle, name, 10.0))
    [message] = vehicle.attitudes()
    assert (message.integrity, message.geometry) == ("unavailable", "")


def test_a_fix_that_does_not_close_is_put_aside() -> None:
    """All six baselines of four antennas are fixed, one with wrong integers at nearly the right place, which no chi-square sees."""
    vehicle = Vehicle(solvers=TRIANGLES)
    say_fixed(vehicle, wrong=("bc",), sure=False)
    [message] = vehicle.attitudes()
    assert is_right(message)
    assert (message.integrity, sorted(message.sources)) == ("ok", sorted(set(TRIANGLES) - {"bc"}))
    assert message.sources_missing == {"bc": "integers of bc do not close with the others"}
    assert vehicle.service.report().counters["triangles_open"] == 2


def test_one_triangle_that_does_not_close_fails() -> None:
    """Which of its three sides is wrong is not to be told."""
    vehicle = Vehicle({name: SQUARE[name] for name in "abc"}, solvers=("ab", "ac", "bc"))
    say_fixed(vehicle, wrong=("bc",), sure=False)
    [message] = vehicle.attitudes()
    assert (message.integrity, message.finding, message.antennas_suspect) == ("failed", "not identifiable", list("abc"))
    assert "integers of ab, bc, ac do not close" in message.reason


def test_triangles_that_close_are_counted() -> None:
    vehicle = Vehicle(solvers=TRIANGLES)
    say_fixed(vehicle)
    assert (vehicle.attitudes()[0].integrity, vehicle.service.report().counters["triangles_closed"]) == ("ok", 4)


def say_fixed(vehicle: Vehicle, wrong: tuple[str, ...] = (), *, sure: bool = True) -> None:
    """Let all be fixed, those ``wrong`` with other integers at the same place; ``sure`` False: the candidates have no clear winner."""
    for name in vehicle.baselines:
        vehicle.say(name, vehicle.baseline(name, 10.0, candidates=True))
        told = vehicle.candidates(name, 10.0, right_norm=4.0 if sure else 25.0)
        if name in wrong:
            integers = np.array(told.integers).reshape(-1, 8)
            integers[0, 3] += 1
            told = msgspec.structs.replace(told, integers=integers.ravel().tolist())
        vehicle.say(name, told)


@pytest.mark.parametrize("mounting_deg", [0.0, 90.0])
def test_two_antennas_of_known_length(mounting_deg: float) -> None:
    """One baseline of which only the length is known; off by default there is nothing else than before."""
    for geometry in (True, False):
        table: dict[str, Any] = {"solver": "ab", "length_m": 2.0, "solvers": (), "antennas": {}, "mounting_deg": mounting_deg}
        vehicle = Vehicle({name: SQUARE[name] for name in "ab"}, **table, geometry=geometry)
        assert AttitudeTable().geometry
        vehicle.say("ab", floating(vehicle, "ab", 10.0))
        assert len(vehicle.attitudes()) == (not geometry)
        vehicle.say("ab", vehicle.candidates("ab", 10.0, wrong_norm=20.0))
        vehicle.say("ab", vehicle.baseline("ab", 11.0, candidates=True))
        first, second = vehicle.attitudes()
        assert (second.integrity, second.sources) == ("ok", {"ab": "baseline"})
        if not geometry:
            assert (first.integrity, first.geometry) == ("unavailable", "")
            continue
        assert (first.integrity, first.geometry, first.sources) == ("ok", "accepted", {"ab": "geometry"})
        assert degrees(first.heading_rad - second.heading_rad) == pytest.approx(0.0, abs=1e-3)
        assert first.covariance_rad2[0] == pytest.approx(second.covariance_rad2[0], rel=0.2)


@pytest.mark.parametrize(
    "values",
    [
        {"covariance_ecef_m2": (1e-300, 0.0, 0.0, 0.0, 1e-300, 0.0, 0.0, 0.0, 1e-300)},
        {"covariance_ecef_m2": (nan,) * 9},
        {"covariance_ecef_m2": (1e8, 0.0, 0.0, 0.0, 1e-12, 0.0, 0.0, 0.0, 1.0)},
        {"norms": [1e300] * 21},
        {"norms": [-5.0] * 21},
        {"baselines_ecef_m": [0.0] * 63},
        {"baselines_ecef_m": [1e8] * 63},
        {"count": 0},
        {"count": 10**9},
        {"beyond": nan},
        {"beyond": 0.0},
        {"integers": [2**62] * 168},
        {"satellite": ["G99"] * 8},
        {"base_ecef_m": (0.0, 0.0, 0.0)},
        {"integers": []},
    ],
)
def test_nonsense_in_candidates_is_not_used(values: dict[str, Any]) -> None:
    """Nothing raises, no epoch is lost or held up, and what comes of it is not called right unless it is."""
    vehicle = Vehicle()
    for tow_s in (10.0, 11.0):
        for name in vehicle.baselines:
            vehicle.say(name, floating(vehicle, name, tow_s))
            told = values if name == "ac" and tow_s == 10.0 else {}
            vehicle.say(name, vehicle.candidates(name, tow_s, **told))
    first, second = vehicle.attitudes()
    assert (second.geometry, is_right(second)) == ("accepted", True)
    assert first.integrity != "ok" or is_right(first) or "ac" not in first.sources
