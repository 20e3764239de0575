"""Attitudes and the baselines that they come from say the same words of integrity."""

from math import nan
from typing import Any

import msgspec
import pytest

from rtkmesh.attitude.baseline import Mounting
from rtkmesh_schemas.config_attitude import AttitudeTable
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_services.attitude.one_baseline import attitude_message

IDENTITY = {"source": "heading", "start_id": "x", "sequence": 0}


def baseline(**values: Any) -> SolutionMessage:
    """A fixed baseline of 1 m to the east."""
    of = {int: 0, float: 0.0, str: ""}
    blank = {f.name: of.get(f.type, (nan,) * (9 if "cov" in f.name else 3)) for f in msgspec.structs.fields(SolutionMessage) if f.required}
    known = {
        "status": 1,
        "status_name": "FIX",
        "baseline_enu_m": (1.0, 0.0, 0.0),
        "baseline_cov_enu_m2": (1e-6, 0, 0, 0, 1e-6, 0, 0, 0, 1e-6),
    }
    return SolutionMessage(**blank | known | values)


@pytest.mark.parametrize(
    ("values", "expected", "reason"),
    [
        ({"integrity": "ok"}, "ok", ""),
        ({"integrity": "unavailable", "integrity_reason": "alert_limit"}, "ok", ""),
        ({"integrity": "failed", "integrity_reason": "codes"}, "failed", "baseline fails its integrity test: codes"),
        ({"integrity": "ok", "baseline_enu_m": (1.2, 0.0, 0.0)}, "failed", "baseline is 1.200 m, known length is 1.000 m"),
        ({"status": 2, "status_name": "FLOAT", "reason": "ratio"}, "unavailable", "baseline is FLOAT: ratio"),
    ],
)
def test_an_attitude_fails_with_its_baseline(values: dict[str, Any], expected: str, reason: str) -> None:
    """A failed test of the baseline, or its length; levels beyond alert limits are the position's affair."""
    found = attitude_message(baseline(**values), AttitudeTable(solver="rtk"), Mounting(length_m=1.0), [], IDENTITY)
    assert (found.integrity, found.reason) == (expected, reason)
