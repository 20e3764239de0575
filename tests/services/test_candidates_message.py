"""Candidates over the wire: what comes out is what went in, and nothing wrong gets in."""

from typing import Any

import msgspec
import numpy as np
import pytest

from rtkmesh.attitude.rotation import NED_FROM_ENU
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.candidates import CandidateTable
from rtkmesh.rtk.solution import Solution
from rtkmesh_schemas.candidates import CandidatesMessage
from rtkmesh_schemas.config import Deployment, SolverTable
from rtkmesh_schemas.config_attitude import AntennaPlaceTable, AttitudeTable
from rtkmesh_schemas.errors import DecodeError
from rtkmesh_schemas.wire import MAXIMUM_BYTES, decode, encode
from rtkmesh_services.mapping.candidates import candidates_message, candidates_of
from rtkmesh_services.solver.known_lengths import known_lengths

BASE = np.array([3783000.0, 901600.0, 5038300.0])


def message(ambiguities: int = 60) -> CandidatesMessage:
    rng = np.random.default_rng(1)
    table = CandidateTable(
        np.arange(1, ambiguities + 1).astype(np.int16) % 32 + 1, np.full(ambiguities, 28, np.int16), np.full(ambiguities, 54, np.int16),
        rng.integers(-(2**22), 2**22, (40, ambiguities)), ambiguities - 2, rng.normal(0.0, 1.0, (40, 3)), 1e-5 * np.eye(3),
        np.arange(40.0), 40.0,
    )  # fmt: skip
    solution = Solution(GpsTime(2445, 5.0), base_ecef_m=BASE, age_s=0.0)
    return candidates_message(table, solution, source="heading", start_id="s", sequence=3, rover="bow", base="stern")


def test_what_arrives_is_what_was_sent() -> None:
    sent = message()
    payload = encode(sent)
    assert len(payload) < MAXIMUM_BYTES / 2
    arrived = decode(CandidatesMessage, payload)
    assert arrived == sent
    found = candidates_of(arrived, 2, 0)
    turn = NED_FROM_ENU @ enu_from_ecef_at(BASE)
    assert (found.start, found.end, found.count, found.beyond) == (2, 0, 58, 40.0)
    assert np.allclose(found.baselines_ned_m @ turn, np.array(sent.baselines_ecef_m).reshape(40, 3))
    assert found.integers.ravel().tolist() == sent.integers
    assert (found.signal[0], found.base_signal[0], found.satellite[0]) == (28, 54, 2)


@pytest.mark.parametrize(
    "changes",
    [
        {"norms": [1.0]}, {"signal": []}, {"integers": [1]}, {"covariance_ecef_m2": (0.0,) * 9}, {"covariance_ecef_m2": (1.0,) * 8},
        {"satellite": ["Q"] * 60}, {"signal": ["??"] * 60}, {"norms": [float("nan")] * 40}, {"base_ecef_m": (float("inf"), 0.0, 0.0)},
    ],
)  # fmt: skip
def test_what_does_not_belong_together_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(DecodeError, match="candidates of heading"):
        candidates_of(msgspec.structs.replace(message(), **changes), 0, 1)


def test_none_are_told_too() -> None:
    """Whoever was promised candidates need not wait for what will not come."""
    told = candidates_message(
        None, Solution(GpsTime(2445, 5.0), base_ecef_m=BASE), source="h", start_id="s", sequence=3, rover="b", base="s"
    )
    assert (candidates_of(decode(CandidatesMessage, encode(told)), 0, 1).norms.size, told.norms) == (0, [])


def test_attitudes_know_the_lengths_of_solvers() -> None:
    """Of placed antennas, both ways, and of one baseline; not where geometry is switched off."""
    places = {name: AntennaPlaceTable(position_m=place, sigma_m=0.003) for name, place in (("a", (0.0, 0.0, 0.0)), ("b", (0.0, 3.0, 4.0)))}
    solver = {"s": SolverTable(rover="d", base="c", mode="moving-base")}
    for geometry in (True, False):
        attitude = {
            "body": AttitudeTable(antennas=places, geometry=geometry),
            "line": AttitudeTable(solver="s", length_m=1.5, length_tolerance_m=0.05, geometry=geometry),
        }
        found = known_lengths(Deployment(solver=solver, attitude=attitude))
        assert set(found) == ({("a", "b"), ("b", "a"), ("c", "d")} if geometry else set())
        if geometry:
            assert found["a", "b"] == (5.0, pytest.approx(np.sqrt(2 * 0.003**2 + 0.005**2)))
            assert found["c", "d"] == (1.5, 0.01)
