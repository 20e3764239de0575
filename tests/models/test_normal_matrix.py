"""The small inverse equals numpy's and knows when there is none."""

import numpy as np
import pytest

from rtkmesh.models.normal_matrix import invert_positive_definite


@pytest.mark.parametrize("size", [1, 3, 8])
def test_inverse_of_a_random_positive_definite_matrix(size: int):
    random = np.random.default_rng(size)
    root = random.normal(size=(size, size))
    matrix, out = root @ root.T + 0.1 * np.eye(size), np.empty((size, size))
    assert invert_positive_definite(matrix, out)
    np.testing.assert_allclose(out @ matrix, np.eye(size), atol=1e-9)
    np.testing.assert_array_equal(out, out.T)


@pytest.mark.parametrize("matrix", [np.ones((3, 3)), np.diag([1.0, -1.0]), np.diag([1.0, np.nan]), np.zeros((2, 2))])
def test_a_singular_indefinite_or_broken_matrix_is_refused(matrix: np.ndarray):
    assert not invert_positive_definite(matrix, np.empty_like(matrix))
