"""The attitude process of several antennas on an in-memory bus: what it makes of its sources, also when some are missing or wrong."""

from itertools import permutations
from math import degrees, hypot, inf, isnan, nan, radians, sin, sqrt
from typing import Any

import msgspec
import numpy as np
import pynmeagps
import pytest
from tests.services.attitude_body import ANGLES_RAD, ECEF_FROM_ENU, ORIGIN_ECEF_M, SQUARE, WEEK, Vehicle

from rtkmesh.attitude.rotation import NED_FROM_ENU, rotation_of_angles, rotation_of_quaternion
from rtkmesh_schemas.attitude import AttitudeMessage, HeadingMessage
from rtkmesh_schemas.config_attitude import BodyPointTable, ReceiverHeadingTable
from rtkmesh_schemas.keys import ATT_NMEA, SOL
from rtkmesh_schemas.status import State
from rtkmesh_services.attitude.matching import Matcher
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.memory_bus import MemoryBus

DOWN = np.array([0.0, 0.0, 2.0])


def angles_deg(message: AttitudeMessage) -> list[float]:
    return [degrees(angle) for angle in (message.heading_rad, message.pitch_rad, message.roll_rad)]


def sigmas_deg(message: AttitudeMessage) -> list[float]:
    return np.degrees(np.sqrt(np.diag(np.array(message.covariance_rad2).reshape(3, 3)))).tolist()


def heading_of(angles_rad: tuple[float, float], tow_s: float, **values: object) -> HeadingMessage:
    told = {
        "source": "a",
        "start_id": "x",
        "sequence": 0,
        "time": (WEEK, tow_s),
        "message": "UNIHEADING",
        "valid": True,
        "solution": "fixed",
    }
    sigmas = {"heading_sigma_rad": radians(0.3), "pitch_sigma_rad": radians(0.6)}
    return msgspec.convert({"heading_rad": angles_rad[0], "pitch_rad": angles_rad[1], **told, **sigmas, **values}, HeadingMessage)


def test_four_antennas_give_the_whole_attitude() -> None:
    """Angles, quaternions of both conventions, and what was used."""
    found = Vehicle().epoch(10.0)
    assert angles_deg(found) == pytest.approx([degrees(a) for a in ANGLES_RAD], abs=1e-6)
    assert (found.integrity, found.finding, found.degrees, found.shape) == ("ok", "ok", 6, "plane")
    assert (found.antennas_used, found.sources) == (list("abcd"), dict.fromkeys(("ab", "ac", "ad"), "baseline"))
    truth = rotation_of_angles(*ANGLES_RAD)
    np.testing.assert_allclose(rotation_of_quaternion(np.array(found.quaternion_ned_from_body)), truth, atol=1e-9)
    enu_from_flu = NED_FROM_ENU @ truth @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(rotation_of_quaternion(np.array(found.quaternion_enu_from_flu)), enu_from_flu, atol=1e-9)
    assert found.waited_ms == 0.0


def test_the_order_of_arrival_changes_nothing() -> None:
    """All orders of three baselines give the same bits; one epoch, one attitude."""
    found = []
    for order in permutations(("ab", "ac", "ad")):
        vehicle = Vehicle()
        for index, name in enumerate(order):
            assert not vehicle.attitudes()
            vehicle.say(name, vehicle.baseline(name, 10.0 + 1e-4 * (name == "ac"), (0.001 * index**0, 0.002, 0.0)))
        [message] = vehicle.attitudes()
        found.append(msgspec.structs.replace(message, start_id="", published_mono_ns=0))
    assert all(msgspec.msgpack.encode(other) == msgspec.msgpack.encode(found[0]) for other in found[1:])


def test_one_antenna_after_the_other_is_lost_and_comes_back() -> None:
    """4, 3, 2, 1, none, and back: each is said, sigmas grow, and "none" is NaN, never 0."""
    vehicle, found = Vehicle(), []
    for index, lost in enumerate(((), ("ad",), ("ac", "ad"), ("ab", "ac", "ad"), ("ac", "ad"), ())):
        found.append(vehicle.epoch(10.0 + index, without=lost))
    assert [len(message.antennas_used) for message in found] == [4, 3, 2, 0, 2, 4]
    assert [message.integrity for message in found] == ["ok", "ok", "ok", "unavailable", "ok", "ok"]
    for better, worse in ((0, 1), (1, 2)):
        assert sigmas_deg(found[better])[0] < sigmas_deg(found[worse])[0]
    assert angles_deg(found[1]) == pytest.approx([degrees(a) for a in ANGLES_RAD], abs=1e-6)
    two, none = found[2], found[3]
    assert degrees(two.heading_rad) == pytest.approx(300.0, abs=3.0 * sigmas_deg(two)[0])
    assert isnan(two.roll_rad)
    assert isnan(two.covariance_rad2[8])
    assert all(isnan(value) for value in (none.heading_rad, none.pitch_rad, none.roll_rad, none.yaw_enu_rad, *none.covariance_rad2))
    assert all(isnan(value) for value in none.quaternion_enu_from_flu)
    assert angles_deg(found[5]) == angles_deg(found[0])
    texts = vehicle.events()
    assert [text.split(" antennas")[0] for text in texts] == [f"attitude from {n} of 4" for n in (4, 3, 2, 0, 2, 4)]
    assert "ad is FLOAT: ratio" in texts[1]


def test_a_baseline_that_is_late_is_left_out_and_counted() -> None:
    """The epoch waits for the deadline and no longer; what comes after it is no second attitude."""
    vehicle = Vehicle(wait_s=0.2)
    vehicle.epoch(10.0)
    vehicle.epoch(11.0)
    for name in ("ab", "ac"):
        vehicle.say(name, vehicle.baseline(name, 12.0))
    vehicle.step(0.15)
    assert len(vehicle.attitudes()) == 2
    assert vehicle.service.due_mono_ns() - vehicle.clock.mono_ns() == pytest.approx(0.05e9, rel=0.01)
    vehicle.step(0.06)
    third = vehicle.attitudes()[2]
    assert (third.antennas_used, third.sources_missing) == (list("abc"), {"ad": "nothing of ad"})
    vehicle.say("ad", vehicle.baseline("ad", 12.0))
    assert len(vehicle.attitudes()) == 3
    report = vehicle.service.report()
    assert (report.counters["late"], report.counters["deadlines"]) == (1, 1)
    assert report.state is State.DEGRADED
    assert {row.name: row.counters for row in report.inputs}["ad"] == {"late": 1}


def test_a_source_that_speaks_of_later_is_not_waited_for() -> None:
    """It has lost an epoch: those of the others go out without any time having passed."""
    vehicle = Vehicle()
    vehicle.epoch(10.0)
    vehicle.epoch(11.0)
    for name in ("ab", "ac"):
        vehicle.say(name, vehicle.baseline(name, 12.0))
    vehicle.say("ad", vehicle.baseline("ad", 13.0))
    assert vehicle.attitudes()[-1].antennas_used == list("abc")


def test_a_replay_waits_longer_than_a_deadline() -> None:
    """What a loaded machine brings late is not late in a recording."""
    vehicle = Vehicle(replay=True)
    vehicle.say("ab", vehicle.baseline("ab", 10.0))
    vehicle.step(1.9)
    for name in ("ac", "ad"):
        vehicle.say(name, vehicle.baseline(name, 10.0))
    assert [message.antennas_used for message in vehicle.attitudes()] == [list("abcd")]


def test_a_dead_source_does_not_hold_up_the_others() -> None:
    """After a few periods its epochs are not waited for at all."""
    vehicle = Vehicle(wait_s=0.2)
    vehicle.epoch(10.0)
    vehicle.epoch(10.2)
    for index in range(1, 10):
        for name in ("ab", "ac"):
            vehicle.say(name, vehicle.baseline(name, 10.2 + 0.2 * index))
        vehicle.step(0.2)
    for name in ("ab", "ac"):
        vehicle.say(name, vehicle.baseline(name, 12.2))
    assert vehicle.attitudes()[-1].tow_s == 12.2


@pytest.mark.parametrize(
    ("rate", "tows"), [("slowest", [10.0, 11.0, 12.0]), ("fastest", [round(10.0 + 0.2 * index, 1) for index in range(11)])]
)
def test_the_rate_is_that_of_the_slowest_or_of_the_fastest(rate: str, tows: list[float]) -> None:
    """Baselines at 5 Hz, positions at 1 Hz."""
    vehicle = Vehicle({"a": SQUARE["a"], "b": SQUARE["b"]}, rate=rate, positions=("pa",))
    for index in range(11):
        tow_s = round(10.0 + 0.2 * index, 1)
        vehicle.say("ab", vehicle.baseline("ab", tow_s))
        if index % 5 == 0:
            vehicle.say("pa", vehicle.position("pa", tow_s))
    published = [message.tow_s for message in vehicle.attitudes()]
    assert published == tows


def test_a_recording_that_begins_anew_is_followed() -> None:
    """Time goes back by more than a few seconds: another beginning, said by a counter."""
    vehicle = Vehicle()
    vehicle.epoch(100.0)
    assert vehicle.epoch(10.0).tow_s == 10.0
    assert vehicle.service.report().counters["restarts"] == 1


def test_a_wrong_baseline_is_found_and_its_antenna_left_out() -> None:
    """Half a metre sideways: the attitude stays right, the antenna is named."""
    found = Vehicle().epoch(10.0, errors={"ad": (0.3, 0.4, 0.0)})
    assert (found.integrity, found.finding, found.antennas_excluded) == ("ok", "excluded", ["d"])
    assert found.antennas_used == list("abc")
    assert angles_deg(found) == pytest.approx([degrees(a) for a in ANGLES_RAD], abs=1e-6)
    assert "without d, which is at fault" in found.reason


def test_what_cannot_be_told_is_said_and_fails() -> None:
    """Three antennas find a fault of one and cannot say of which."""
    vehicle = Vehicle({name: SQUARE[name] for name in "abc"})
    found = vehicle.epoch(10.0, errors={"ac": (0.2, 0.2, 0.0)})
    assert (found.integrity, found.finding) == ("failed", "not identifiable")
    assert found.antennas_suspect
    assert vehicle.service.report().state is State.DEGRADED


def test_positions_give_points_of_the_body_with_the_bases_error() -> None:
    """The keel's place: from antennas 2 m above it; its sigma is no better than what all positions share."""
    vehicle = Vehicle(positions=("pa", "pd"), points={"keel": BodyPointTable(position_m=(0.0, 0.0, 2.0))})
    for name in vehicle.baselines:
        vehicle.say(name, vehicle.baseline(name, 10.0))
    for name in ("pa", "pd"):
        vehicle.say(name, vehicle.position(name, 10.0, velocity_ecef_mps=(1.0, 2.0, 3.0)))
    [message] = vehicle.attitudes()
    keel = message.points["keel"]
    expected = ORIGIN_ECEF_M + ECEF_FROM_ENU @ NED_FROM_ENU @ rotation_of_angles(*ANGLES_RAD) @ DOWN
    np.testing.assert_allclose(keel.position_ecef_m, expected, atol=1e-6)
    assert 0.01 < sqrt(keel.cov_enu_m2[0]) < 0.03, "4 m below antennas 1.2 m apart whose heights are good to 8 mm"
    assert (message.antennas_used, message.integrity) == (list("abcd"), "ok")
    assert keel.lat_deg == pytest.approx(52.5, abs=1e-3)


@pytest.mark.parametrize(("late_s", "clock_s"), [(0.001, 0.0), (0.0, 0.0007), (0.001, 0.0005), (0.0, nan), (0.0, 5.0)])
def test_positions_of_two_instants_meet_at_one(late_s: float, clock_s: float) -> None:
    """Tags and clocks of receivers: a millisecond at 20 m/s, 2 cm that are no fault. A clock that is none moves nothing."""
    vehicle = Vehicle(solvers=(), positions=("pa", "pb", "pc", "pd"))
    east = tuple((ECEF_FROM_ENU @ np.array([20.0, 0.0, 0.0])).tolist())
    ahead_s = clock_s if clock_s < 0.1 else 0.0
    for name in ("pa", "pb", "pc", "pd"):
        mine = name == "pd"
        error_m = 20.0 * (late_s - ahead_s) if mine else 0.0
        told = {"velocity_ecef_mps": east, "receiver_clock_s": clock_s if mine else 0.0}
        vehicle.say(name, vehicle.position(name, 10.0 + late_s * mine, (error_m, 0.0, 0.0), **told))
    [message] = vehicle.attitudes()
    assert angles_deg(message) == pytest.approx([degrees(a) for a in ANGLES_RAD], abs=1e-4)
    assert message.chi_square < 1e-6


def test_without_positions_points_are_not_known() -> None:
    found = Vehicle(points={"keel": BodyPointTable(position_m=(0.0, 0.0, 2.0))}).epoch(10.0)
    assert all(isnan(value) for value in (*found.points["keel"].position_ecef_m, found.points["keel"].height_m))


def test_a_receivers_heading_alone() -> None:
    """Mounted across: heading and roll. Nothing tests it, and that is said. Invalid is NaN, not north."""
    vehicle = Vehicle(solvers=(), antennas={}, headings={"a": ReceiverHeadingTable(mounting_deg=90.0)})
    vehicle.say("a", heading_of((radians(30.0), radians(5.0)), 10.0))
    vehicle.say("a", heading_of((nan, nan), 11.0, valid=False, solution="none"))
    vehicle.say("a", heading_of((radians(30.0), nan), 12.0, time=None))
    good, none = vehicle.attitudes()
    assert angles_deg(good)[::2] == pytest.approx([300.0, -5.0], abs=0.01)
    assert isnan(good.pitch_rad)
    assert (good.integrity, good.finding, good.reason) == ("ok", "no redundancy", "nothing tests it")
    assert sigmas_deg(good)[0] == pytest.approx(hypot(0.3, 10.0 * sin(radians(5.0))), rel=0.02), "pitch is not seen, and the line not level"
    assert isnan(none.heading_rad)
    assert (none.integrity, none.reason) == ("unavailable", "no attitude; a has no heading (UNIHEADING none)")
    assert vehicle.service.report().counters["untimed"] == 1


def test_a_receiver_that_tells_a_whole_attitude() -> None:
    """AttEuler's heading, pitch and roll, with their sigmas; turned with the receiver; without its roll the heading is what it was."""
    told = {"message": "AttEuler", "of_baseline": False, "roll_rad": radians(-6.0), "roll_sigma_rad": radians(0.9)}
    vehicle = Vehicle(solvers=(), antennas={}, headings={"a": ReceiverHeadingTable()})
    vehicle.say("a", heading_of((radians(300.0), radians(3.0)), 10.0, **told))
    vehicle.say("a", heading_of((radians(300.0), radians(3.0)), 11.0, **{**told, "roll_rad": nan}))
    whole, line = vehicle.attitudes()
    assert angles_deg(whole) == pytest.approx([300.0, 3.0, -6.0], abs=1e-3)
    assert sigmas_deg(whole) == pytest.approx([0.3, 0.6, 0.9], rel=0.05)
    assert (whole.integrity, whole.finding, whole.reason) == ("ok", "no redundancy", "nothing tests it")
    assert whole.protection_rad == (inf, inf, inf), "the receiver is one thing: nothing bounds what it says"
    assert angles_deg(line)[:2] == pytest.approx([300.0, 3.0], abs=1e-3)
    assert isnan(line.roll_rad)
    turned = Vehicle(solvers=(), antennas={}, headings={"a": ReceiverHeadingTable(mounting_deg=90.0)})
    turned.say("a", heading_of((radians(30.0), radians(6.0)), 10.0, **{**told, "roll_rad": radians(3.0)}))
    assert angles_deg(turned.attitudes()[0])[:2] == pytest.approx([300.0, 3.0], abs=0.4)


def test_a_whole_attitude_that_contradicts_the_baselines_is_left_out() -> None:
    """A roll that is off by ten degrees."""
    vehicle = Vehicle(headings={"a": ReceiverHeadingTable()})
    for name in vehicle.baselines:
        vehicle.say(name, vehicle.baseline(name, 10.0))
    told = {"message": "AttEuler", "of_baseline": False, "roll_rad": radians(4.0), "roll_sigma_rad": radians(0.5)}
    vehicle.say("a", heading_of((radians(300.0), radians(3.0)), 10.0, **told))
    [message] = vehicle.attitudes()
    assert message.sources_missing == {"a": "a contradicts the others"}
    assert angles_deg(message) == pytest.approx([degrees(a) for a in ANGLES_RAD], abs=1e-6)


def test_a_receivers_heading_of_a_pair_stands_in_for_its_baseline() -> None:
    """Both come from the same observations: it is used only while the baseline is not there."""
    vehicle = Vehicle({name: SQUARE[name] for name in "ab"}, headings={"a": ReceiverHeadingTable(antennas=("a", "b"))})
    for tow_s, status in ((10.0, 1), (11.0, 2)):
        vehicle.say("ab", vehicle.baseline("ab", tow_s, status=status))
        vehicle.say("a", heading_of((radians(300.0), radians(3.0)), tow_s))
    both, alone = vehicle.attitudes()
    assert (both.sources, alone.sources) == ({"ab": "baseline"}, {"a": "heading"})
    assert degrees(alone.heading_rad) == pytest.approx(300.0, abs=0.01)


def test_a_heading_that_contradicts_the_baselines_is_left_out() -> None:
    """Its own line of antennas is blamed as one thing."""
    vehicle = Vehicle(headings={"a": ReceiverHeadingTable()})
    for name in vehicle.baselines:
        vehicle.say(name, vehicle.baseline(name, 10.0))
    vehicle.say("a", heading_of((radians(310.0), radians(3.0)), 10.0))
    [message] = vehicle.attitudes()
    assert message.sources_missing == {"a": "a contradicts the others"}
    assert (message.integrity, message.antennas_used) == ("ok", list("abcd"))
    assert angles_deg(message) == pytest.approx([degrees(a) for a in ANGLES_RAD], abs=1e-6)


@pytest.mark.parametrize(
    "values",
    [
        {"baseline_enu_m": (nan, nan, nan)},
        {"baseline_cov_enu_m2": (0.0,) * 9},
        {"baseline_cov_enu_m2": (1.0, 0.0)},
        {"baseline_cov_enu_m2": (-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)},
        {"baseline_cov_enu_m2": (float("inf"),) * 9},
        {"integrity": "failed", "integrity_reason": "codes"},
        {"baseline_enu_m": (1e300, 0.0, 0.0)},
        {"baseline_cov_enu_m2": (1e300, 0.0, 0.0, 0.0, 1e-300, 0.0, 0.0, 0.0, 1.0)},
    ],
)
def test_nonsense_of_a_source_is_not_used(values: dict[str, Any]) -> None:
    """The others go on; nothing raises, and nothing that is not finite is called right."""
    vehicle = Vehicle()
    for name in vehicle.baselines:
        vehicle.say(name, vehicle.baseline(name, 10.0, **(values if name == "ad" else {})))
    [message] = vehicle.attitudes()
    assert message.antennas_used == list("abc")
    assert angles_deg(message) == pytest.approx([degrees(a) for a in ANGLES_RAD], abs=1e-6)


def test_bytes_and_times_that_are_none_are_counted() -> None:
    vehicle = Vehicle()
    vehicle.say("ab", vehicle.baseline("ab", -1.0))
    vehicle.say("ab", vehicle.baseline("ab", nan))
    vehicle.service.handle(Sample("rtk/ac/sol", b"\xff\x00", "", b"", 0))
    assert {row.name: row.errors for row in vehicle.service.report().inputs} == {"ab": 2, "ac": 1, "ad": 0}


def test_nmea_is_said_to_who_listens() -> None:
    """HDT and THS by their published form; without a heading THS says V and HDT nothing: no north of nowhere."""
    vehicle = Vehicle()
    vehicle.epoch(10.0)
    assert not vehicle.bus.sent(ATT_NMEA), "nobody listens"
    MemoryBus("listener", vehicle.network).subscribe(ATT_NMEA.key("body"), lambda _: None)
    vehicle.epoch(11.0)
    vehicle.epoch(12.0, without=("ab", "ac", "ad"))
    lines = [pynmeagps.NMEAReader.parse(line) for sample in vehicle.bus.sent(ATT_NMEA) for line in sample.payload.splitlines(keepends=True)]
    assert [(line.msgID, line.payload) for line in lines] == [("HDT", ["300.000", "T"]), ("THS", ["300.000", "A"]), ("THS", ["", "V"])]


def test_an_empty_matcher_is_never_due() -> None:
    assert Matcher(("a",), 0.1, slowest=True).due_s() == float("inf")


def test_a_replay_drops_no_solution_however_far_behind_the_attitude_is() -> None:
    """More than an inbox's usual capacity, before the process takes the first."""
    vehicle = Vehicle({name: SQUARE[name] for name in "ab"}, replay=True)
    bus = MemoryBus("ab", vehicle.network)
    for index in range(1500):
        bus.publish(SOL, vehicle.baseline("ab", 10.0 + 0.2 * index))
    for _ in range(1600):
        vehicle.life.step(0.0)
    assert len(vehicle.attitudes()) == 1500


def test_a_source_that_was_lost_is_waited_for_again() -> None:
    """It comes back a little after the others, which the epochs do not wait for: late once, then in."""
    vehicle = Vehicle(wait_s=0.1)
    for index in range(11):
        for name in vehicle.baselines:
            vehicle.step(0.01)
            if name != "ad" or index < 2 or index > 7:
                vehicle.say(name, vehicle.baseline(name, 10.0 + index))
        vehicle.step(0.2)
    assert [len(message.antennas_used) for message in vehicle.attitudes()[-3:]] == [3, 4, 4]
    assert vehicle.service.report().counters["late"] == 1


def test_it_says_how_long_the_last_source_waited() -> None:
    """From its arrival at the process: what an epoch waits for its deadline is in it, what it waited for its sources is not."""
    vehicle = Vehicle(wait_s=0.2)
    vehicle.epoch(10.0)
    for name in ("ab", "ac", "ad"):
        vehicle.step(0.05)
        vehicle.say(name, vehicle.baseline(name, 11.0))
    vehicle.say("ab", vehicle.baseline("ab", 12.0))
    vehicle.say("ac", vehicle.baseline("ac", 12.0))
    vehicle.step(0.3)
    assert [round(message.waited_ms) for message in vehicle.attitudes()[-2:]] == [0, 300]
