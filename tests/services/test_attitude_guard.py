"""Protection levels of published attitudes, and the alert limits of a site."""

from dataclasses import replace
from math import degrees, inf, isfinite, isnan, nan

import pytest
from tests.services.attitude_body import SQUARE, Vehicle

from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.config_attitude import AttitudeFilterTable, AttitudeIntegrityTable
from rtkmesh_schemas.keys import ATT_FILTERED
from rtkmesh_services.attitude.body import BodyAttitude
from rtkmesh_services.attitude.geometry import Chosen
from rtkmesh_services.attitude.guard import Guard

TRIO = {name: SQUARE[name] for name in "abc"}
PAIR = {name: SQUARE[name] for name in "ab"}


def table(**values: float) -> AttitudeIntegrityTable:
    return AttitudeIntegrityTable(**values)


def test_four_antennas_bound_every_angle() -> None:
    """Above the sigmas, below what three antennas have; nothing is open, and the filter's message claims none."""
    vehicle = Vehicle(filter=AttitudeFilterTable())
    found = vehicle.epoch(10.0)
    assert all(isfinite(level) for level in found.protection_rad)
    assert all(level**2 > 20.0 * variance for level, variance in zip(found.protection_rad, found.covariance_rad2[::4], strict=True))
    assert found.protection_open == []
    assert vehicle.attitudes(ATT_FILTERED)[-1].protection_rad == pytest.approx((nan, nan, nan), nan_ok=True)
    three = vehicle.epoch(11.0, without=("ad",))
    assert all(more > less for more, less in zip(three.protection_rad, found.protection_rad, strict=True))


def test_a_fault_below_the_tests_limit_is_within_the_levels() -> None:
    """Six centimetres of height of one antenna pass the test and tilt the attitude by more than three sigmas."""
    clean, wrong = Vehicle().epoch(10.0), Vehicle().epoch(10.0, errors={"ad": (0.0, 0.0, 0.06)})
    assert wrong.finding == "ok"
    roll = abs(wrong.roll_rad - clean.roll_rad)
    assert roll**2 > 9.0 * wrong.covariance_rad2[8]
    assert roll < wrong.protection_rad[2]
    assert wrong.protection_rad[2] > clean.protection_rad[2]


def test_two_antennas_bound_nothing_and_say_so() -> None:
    """By places or by mounting: heading and pitch are not bounded, roll is not seen; a rarer fault than the risk is not looked at."""
    for found in (Vehicle(PAIR).epoch(10.0), Vehicle(PAIR, solver="ab", solvers=(), antennas={}, length_m=2.0).epoch(10.0)):
        assert found.protection_rad[:2] == (inf, inf)
        assert isnan(found.protection_rad[2])
        assert (found.integrity, found.protection_open) == ("ok", ["a", "b"])
    for told in ({}, {"solver": "ab", "solvers": (), "antennas": {}, "length_m": 2.0}):
        trusting = Vehicle(PAIR, integrity=table(antenna_fault=0.0), **told).epoch(10.0)
        assert isfinite(trusting.protection_rad[0])
        assert trusting.protection_open == []
        feared = Vehicle(PAIR, integrity=table(antenna_fault=0.0), **told)
        feared.say("ab", feared.baseline("ab", 10.0, fix_probability=0.99))
        assert feared.attitudes()[-1].protection_rad[0] == inf, "wrong integers are heading, too"


def test_two_antennas_are_bounded_by_the_levels_of_their_baseline() -> None:
    """What its solver tells, over its length; antennas stay open, and a solver that takes a larger risk bounds nothing."""
    told = {"protection_horizontal_m": 0.1, "protection_vertical_m": 0.2}
    by_length = {"solver": "ab", "solvers": (), "antennas": {}, "length_m": 2.0}
    for values in ({}, by_length):
        vehicle = Vehicle(PAIR, **values)
        vehicle.say("ab", vehicle.baseline("ab", 10.0, **told))
        found = vehicle.attitudes()[-1]
        assert found.protection_rad[0] == pytest.approx(0.1 / 2.0, rel=0.02)
        assert found.protection_rad[1] == pytest.approx(0.2 / 2.0, rel=0.05)
        assert isnan(found.protection_rad[2])
        assert (found.integrity, found.protection_open) == ("ok", ["a", "b"])
        careful = Vehicle(PAIR, integrity=table(risk=1e-6, alert_heading_deg=5.0), **values)
        careful.say("ab", careful.baseline("ab", 10.0, **told))
        assert "heading is not bounded" in careful.attitudes()[-1].reason
    three = Vehicle(TRIO)
    three.say("ab", three.baseline("ab", 10.0, **told))
    three.say("ac", three.baseline("ac", 10.0, status=2, status_name="FLOAT", reason="ratio"))
    assert three.attitudes()[-1].protection_rad[0] == pytest.approx(0.05, rel=0.02), "what is left of three"


def test_levels_beyond_their_limits_are_unavailable() -> None:
    """With four antennas all is inside; three do not bound a tilt; an attitude that failed stays so."""
    limits = table(alert_heading_deg=6.0, alert_tilt_deg=5.0)
    vehicle = Vehicle(integrity=limits)
    assert vehicle.epoch(10.0).integrity == "ok"
    three = vehicle.epoch(11.0, without=("ad",))
    assert three.integrity == "unavailable"
    assert f"roll may be off by {degrees(three.protection_rad[2]):.1f} deg (limit 5 deg)" in three.reason
    assert "heading" not in three.reason
    assert "heading is not bounded (limit 6 deg)" in Vehicle(PAIR, integrity=limits).epoch(10.0).reason
    failed = Vehicle(TRIO, integrity=limits).epoch(10.0, errors={"ac": (0.2, 0.2, 0.0)})
    assert failed.integrity == "failed"
    assert all(isnan(level) for level in vehicle.epoch(12.0, without=("ab", "ac", "ad")).protection_rad)


def test_wrong_integers_that_the_solver_fears_raise_the_level() -> None:
    """One baseline's fix is wrong with a probability of a tenth: its antenna is likelier to be at fault."""
    levels = []
    for probability in (0.999999, 0.9):
        vehicle = Vehicle(integrity=table(antenna_fault=1e-5))
        for name in vehicle.baselines:
            vehicle.say(name, vehicle.baseline(name, 10.0, fix_probability=probability if name == "ad" else 0.999999))
        levels.append(vehicle.attitudes()[-1].protection_rad)
    assert all(likely > rare for likely, rare in zip(levels[1], levels[0], strict=True))


@pytest.mark.parametrize(("wrong", "bounded"), [(1e-3, False), (1e-7, True)])
def test_integers_that_were_chosen_together_are_wrong_together(monkeypatch: pytest.MonkeyPatch, wrong: float, bounded: bool) -> None:
    """One combination of all baselines: where it is wrong with more than a share of the risk, no antenna is left to bound it."""
    of_body = Guard.of_body

    def chosen(guard: Guard, found: BodyAttitude, message: AttitudeMessage) -> AttitudeMessage:
        readings = tuple(replace(reading, chosen=True) for reading in found.readings)
        return of_body(guard, replace(found, readings=readings, chosen=Chosen({}, "accepted", wrong)), message)

    monkeypatch.setattr(Guard, "of_body", chosen)
    found = Vehicle().epoch(10.0)
    assert all(isfinite(level) is bounded for level in found.protection_rad)
    assert found.protection_open == ([] if bounded else list("abcd"))
