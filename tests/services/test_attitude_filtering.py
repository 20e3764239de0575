"""The filter in the attitude process: epochs and a gyro in, an attitude that goes on, out on a key of its own."""

from math import degrees, isnan, nan, radians
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.services.attitude_body import ANGLES_RAD, WEEK, Vehicle

from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.config_attitude import AttitudeFilterTable, ImuTable
from rtkmesh_schemas.errors import DecodeError
from rtkmesh_schemas.keys import ATT_FILTERED
from rtkmesh_services.attitude.imu import ImuSample, imu_sample
from rtkmesh_services.runtime.bus import Sample


def say_gyro(vehicle: Vehicle, tow_s: float, rate_radps: tuple[float, float, float], **fields: Any) -> None:
    """Let the vehicle's gyro speak, as JSON."""
    payload = msgspec.json.encode({"rate_radps": rate_radps, "week": WEEK, "tow_s": tow_s, **fields})
    vehicle.service.handle(Sample("vehicle/imu", payload, "application/json", b"", 0))


def test_the_filtered_attitude_goes_on_while_epochs_are_missing() -> None:
    """Epochs without a fix: sigmas grow, then there is none; back it is told nothing but the truth."""
    vehicle = Vehicle(filter=AttitudeFilterTable(max_coast_s=3.0, rate_walk_radps_rts=0.02))
    for index in range(10):
        vehicle.epoch(10.0 + 0.2 * index)
    for index in range(6):
        vehicle.epoch(12.0 + index, without=("ab", "ac", "ad"))
    found = vehicle.attitudes(ATT_FILTERED)
    assert [round(message.predicted_s, 6) for message in found[9:13]] == [0.0, 0.2, 1.2, 2.2]
    assert degrees(found[10].heading_rad) == pytest.approx(degrees(ANGLES_RAD[0]), abs=0.05)
    assert found[9].covariance_rad2[0] < found[10].covariance_rad2[0] < found[11].covariance_rad2[0]
    assert all(not isnan(value) for value in (*found[9].rate_radps, *found[9].rate_cov_rad2ps2, *found[9].quaternion_ned_from_body))
    assert [message.integrity for message in found[13:]] == ["unavailable"] * 3
    assert isnan(found[-1].heading_rad)
    assert found[-1].reason == "filter: gap"
    assert len(vehicle.attitudes()) == len(found)


def test_a_gyro_turns_the_attitude_between_epochs() -> None:
    """A tenth of a radian a second about down, at every sample a message."""
    vehicle = Vehicle(filter=AttitudeFilterTable(publish="gyro"), imu=ImuTable(key="vehicle/imu", sigma_radps=0.001))
    for index in range(11):
        say_gyro(vehicle, 9.0 + 0.1 * index, (1e-6 * index, 0.0, 0.0))
    vehicle.epoch(10.0)
    before = vehicle.attitudes(ATT_FILTERED)
    for index in range(1, 6):
        say_gyro(vehicle, 10.0 + 0.02 * index, (1e-6 * index, 0.0, 0.0))
    found = vehicle.attitudes(ATT_FILTERED)[len(before) :]
    assert [round(message.tow_s, 3) for message in found] == [10.02, 10.04, 10.06, 10.08, 10.1]
    assert degrees(found[-1].heading_rad) == pytest.approx(degrees(ANGLES_RAD[0]), abs=0.1)
    vehicle.service.handle(Sample("vehicle/imu", b"nonsense", "text/plain", b"", 0))
    say_gyro(vehicle, 10.2, (nan, 0.0, 0.0))
    [row] = [row for row in vehicle.service.report().inputs if row.name == "vehicle/imu"]
    assert (row.messages, row.errors) == (18, 2)


def test_a_jump_is_gated_and_one_that_stays_is_told() -> None:
    """One wrong epoch changes nothing; many that agree begin the filter anew, with an event."""
    vehicle = Vehicle(filter=AttitudeFilterTable())
    for index in range(20):
        vehicle.epoch(10.0 + 0.2 * index)
    turned = dict.fromkeys(vehicle.baselines, (0.0, 0.0, 0.0))
    vehicle.places = {name: place * (-1.0, -1.0, 1.0) for name, place in vehicle.places.items()}  # the vehicle looks the other way
    vehicle.epoch(14.0, errors=turned)
    first = vehicle.attitudes(ATT_FILTERED)[-1]
    assert degrees(first.heading_rad) == pytest.approx(300.0, abs=0.5)
    for index in range(1, 10):
        vehicle.epoch(14.0 + 0.2 * index, errors=turned)
    last = vehicle.attitudes(ATT_FILTERED)[-1]
    assert degrees(last.heading_rad) == pytest.approx(120.0, abs=1.0)
    assert last.resets == 1
    assert vehicle.service.report().counters["filter_epochs_reset"] == 1


def test_the_scalar_heading_filter_is_a_choice() -> None:
    """It has a heading and its rate, and no tilt."""
    vehicle = Vehicle(filter=AttitudeFilterTable(kind="heading"))
    for index in range(5):
        vehicle.epoch(10.0 + 0.2 * index)
    last = vehicle.attitudes(ATT_FILTERED)[-1]
    assert degrees(last.heading_rad) == pytest.approx(300.0, abs=0.1)
    assert isnan(last.roll_rad)
    assert last.integrity == "ok"


def test_times_of_a_gyro() -> None:
    """GPS time, or seconds since 1970."""
    rate = [0.1, 0.2, 0.3]
    assert imu_sample({"rate_radps": rate, "week": 2400, "tow_s": 1.5}) == ImuSample(GpsTime(2400, 1.5), (0.1, 0.2, 0.3))
    time = imu_sample({"rate_radps": rate, "utc_s": 1_700_000_000.25}).time
    assert time - GpsTime.normalized(0, 1_700_000_000.25 - 315964800.0 + 18.0) == pytest.approx(0.0, abs=1e-5)


_ONE = st.none() | st.booleans() | st.floats() | st.integers() | st.just(10**400) | st.text(max_size=3)
_FIELDS = ("rate_radps", "force_mps2", "yaw_increment_rad", "interval_s", "week", "tow_s", "utc_s")
_ANY = _ONE | st.lists(_ONE, max_size=4)


@settings(max_examples=60, deadline=None)
@given(_ANY | st.fixed_dictionaries(dict.fromkeys(_FIELDS, _ANY)))
def test_any_programs_message_is_a_sample_or_refused(message: object) -> None:
    """Whatever comes on the key."""
    try:
        sample = imu_sample(message)
    except DecodeError:
        return
    assert sample.time.week >= 0
    assert all(abs(value) < radians(1e102) for part in (sample.rate_radps, sample.force_mps2, sample.yaw) for value in part or ())
