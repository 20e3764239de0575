"""The arithmetic of benchmarks/integrity.py: what is wrong, beyond, available and hazardous."""

from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

NAMES = ("integrity",)
FIX, FLOAT = 1.0, 2.0


@pytest.fixture(scope="module")
def integrity(benchmarks: SimpleNamespace) -> ModuleType:
    """The benchmark's module."""
    return benchmarks.integrity


def test_shares_of_known_errors(integrity: ModuleType):
    """One run with a wrong fix inside small levels, one with a fix of poor geometry and a float within its levels."""
    # status, east, north, up, sigma, probability of wrong, levels, flag
    first = np.array([[FIX, 0.01, 0.0, 0.01, 0.01, 1e-6, 0.05, 0.1, 0], [FIX, 0.3, 0.0, 0.0, 0.01, 1e-6, 0.05, 0.1, 0]])
    second = np.array([[FIX, 0.0, 0.0, 0.2, 0.1, 1e-6, np.inf, np.inf, 2], [FLOAT, 0.5, 0.0, -0.9, 0.3, 1.0, 0.8, 1.0, 0]])
    found = integrity.figures([integrity.Checked("a", 0, first), integrity.Checked("a", 1, second)])
    (bin_,) = found["probabilities"]
    assert (bin_["fixes"], bin_["wrong"], bin_["far_within_sigma"], bin_["runs_with_wrong"], bin_["runs"]) == (3, 1, 1, 1, 2)
    fix, float_ = (row for row in found["levels"] if row["data"] == "total")
    assert (fix["beyond"], fix["runs_with_beyond"], fix["unbounded"], float_["beyond"]) == (1, 1, 1, 0)
    close, wide = (row for row in found["alerts"] if row["data"] == "total" and row["status"] == "FIX")
    assert (close["available"], close["misleading"], close["hazardous"]) == (2, 0, 1)
    assert (wide["available"], wide["misleading"], wide["hazardous"]) == (2, 1, 0)
    flags = next(row for row in found["flags"] if row["data"] == "total" and row["status"] == "FIX")
    assert (flags["right"], flags["wrong"]) == ([1, 0, 1], [1, 0, 0])
    assert "| 0e+00 to 2e-06 | 3 |" in integrity.page(found)
