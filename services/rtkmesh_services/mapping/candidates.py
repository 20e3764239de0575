"""Candidates of an epoch to the wire, and from there to what the attitude's search takes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.candidates import Candidates
from rtkmesh.attitude.rotation import NED_FROM_ENU
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.signals import satellite_id, satellite_number, signal_code, signal_number
from rtkmesh.rtk.candidates import CandidateTable
from rtkmesh.rtk.solution import Solution
from rtkmesh_schemas.candidates import CandidatesMessage
from rtkmesh_schemas.errors import DecodeError

Matrix = NDArray[np.float64]

_LARGEST = 1e9  # no earth is so large, nor a norm of integers that anybody would choose (nor is NaN)
_NUMBERS = np.zeros(0, np.int16)
_NONE = CandidateTable(_NUMBERS, _NUMBERS, _NUMBERS, np.zeros((0, 0), np.int64), 0, np.zeros((0, 3)), np.eye(3), np.zeros(0), 0.0)


def candidates_message(found: CandidateTable | None, solution: Solution, **identity: Any) -> CandidatesMessage:
    """Return a table as the wire's struct, None as one of no candidates; ``identity``: source, start_id, sequence, rover, base, clocks."""
    table = _NONE if found is None else found
    x, y, z = solution.base_ecef_m.tolist()
    return CandidatesMessage(
        week=solution.time.week,
        tow_s=solution.time.tow_s,
        satellite=[satellite_id(number) for number in table.satellite.tolist()],
        signal=[signal_code(number) for number in table.signal.tolist()],
        base_signal=[signal_code(number) for number in table.base_signal.tolist()],
        count=table.count,
        integers=table.integers.ravel().tolist(),
        baselines_ecef_m=table.baselines_ecef_m.ravel().tolist(),
        covariance_ecef_m2=tuple(table.cov_ecef_m2.ravel().tolist()),
        norms=table.norms.tolist(),
        beyond=float(table.beyond),
        base_ecef_m=(x, y, z),
        age_s=float(solution.age_s),
        **identity,
    )


def candidates_of(message: CandidatesMessage, start: int, end: int) -> Candidates:
    """Return the candidates of a message between two antennas of a layout (``start`` has the base's receiver), in NED at the base.

    DecodeError where its lists do not belong together or hold what cannot be used.
    """
    m, p = len(message.norms), len(message.satellite)
    lengths = (len(message.signal), len(message.base_signal), len(message.integers), len(message.baselines_ecef_m))
    if lengths != (p, p, m * p, 3 * m) or len(message.covariance_ecef_m2) != 9:
        raise DecodeError(f"candidates of {message.source}: {m} of {p} ambiguities do not go with lists of {lengths}")
    numbers = np.array([*message.norms, *message.baselines_ecef_m, *message.covariance_ecef_m2, *message.base_ecef_m])
    cov = np.array(message.covariance_ecef_m2).reshape(3, 3)
    if (
        not (np.abs(numbers).max() < _LARGEST and 0 <= message.count <= p and message.beyond >= 0.0)
        or np.linalg.eigvalsh(0.5 * (cov + cov.T))[0] <= 0.0
    ):
        raise DecodeError(f"candidates of {message.source}: not finite, too large, or a covariance that is none")
    turn: Matrix = NED_FROM_ENU @ enu_from_ecef_at(np.array(message.base_ecef_m))
    try:
        satellite = np.array([satellite_number(name) for name in message.satellite], np.int16)
        signal, base_signal = (np.array([signal_number(c) for c in codes], np.int16) for codes in (message.signal, message.base_signal))
        integers = np.array(message.integers, np.int64).reshape(m, p)
    except (ValueError, KeyError, OverflowError) as error:
        raise DecodeError(f"candidates of {message.source}: {error}") from error
    return Candidates(
        start, end, np.array(message.baselines_ecef_m).reshape(m, 3) @ turn.T, turn @ cov @ turn.T, np.array(message.norms),
        message.count, message.beyond, satellite, signal, base_signal, integers,
    )  # fmt: skip
