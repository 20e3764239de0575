"""Integer least squares against RTKLIB's ``lambda`` (demo5 by PyPI pyrtklib5)."""

import numpy as np
import pytest

from rtkmesh.rtk.lambda_search import OK, integer_least_squares

rtklib = pytest.importorskip("pyrtklib5")


def theirs(a, Q):
    n = len(a)
    arrays = [rtklib.Arr1Ddouble(size) for size in (n, n * n, 2 * n, 2)]
    for i in range(n):
        arrays[0][i] = a[i]
        for j in range(n):
            arrays[1][i + n * j] = Q[i, j]
    info = getattr(rtklib, "lambda")(n, 2, *arrays)
    return info, np.array([[arrays[2][c * n + i] for i in range(n)] for c in range(2)]), np.array([arrays[3][0], arrays[3][1]])


@pytest.mark.rtklib
@pytest.mark.parametrize("n", [1, 2, 4, 8, 15, 30, 50])
def test_same_candidates_and_norms(n):
    """Both candidates are the same integers and their norms agree to 7 digits."""
    rng = np.random.default_rng(n)
    for _ in range(5):
        H = rng.normal(size=(n, min(n, 3)))
        Q = H @ H.T * rng.uniform(0.1, 0.5) ** 2 + np.diag(rng.uniform(5e-4, 2e-3, n)) + 5e-4
        a = rng.integers(-1000, 1000, n) + rng.multivariate_normal(np.zeros(n), Q)
        fixed, norms, D = np.zeros((2, n)), np.zeros(2), np.zeros(n)
        assert integer_least_squares(a, Q.copy(), 100_000, fixed, norms, D) == OK
        info, expected, expected_norms = theirs(a, Q)
        assert info == 0
        assert norms == pytest.approx(expected_norms, rel=1e-6)
        assert np.array_equal(fixed, np.rint(expected))
