"""Eigenvalues without LAPACK, held against LAPACK's."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.attitude.symmetric import applied, eigen, product, squared


@settings(max_examples=60, deadline=None)
@given(n=st.integers(1, 9), seed=st.integers(0, 2**31), rank=st.integers(0, 9), scale=st.sampled_from([1e-8, 1.0, 1e8]))
def test_eigenvalues_and_axes_are_those_of_lapack(n: int, seed: int, rank: int, scale: float) -> None:
    """Also of matrices that are singular, zero, or small."""
    half = np.random.default_rng(seed).normal(size=(n, min(rank, n)))
    matrix = scale * half @ half.T
    values, vectors = eigen(matrix)
    largest = max(float(np.abs(matrix).max(initial=0.0)), 1e-300)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), atol=1e-13 * n * largest * n)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-13 * n)
    np.testing.assert_allclose((vectors * values) @ vectors.T, matrix, atol=1e-13 * n * n * largest)


def test_equal_eigenvalues_and_nonsense_end() -> None:
    """Equal ones need no turn; of NaN nothing comes but NaN."""
    values, vectors = eigen(3.0 * np.eye(4))
    assert (values.tolist(), vectors.tolist()) == ([3.0] * 4, np.eye(4).tolist())
    assert np.isnan(eigen(np.full((3, 3), np.nan))[0]).all()


def test_an_element_next_to_nothing_is_nothing() -> None:
    """Subnormal ones too: the ratio of the diagonal to them would overflow."""
    values, vectors = eigen(np.array([[2.0, 3e-311], [3e-311, 0.0]]))
    assert (values.tolist(), np.abs(vectors).tolist()) == ([0.0, 2.0], [[0.0, 1.0], [1.0, 0.0]])


def test_products_are_those_of_numpy() -> None:
    """Matrices of any memory order."""
    rng = np.random.default_rng(1)
    a, b, weight, v = rng.normal(size=(4, 6)), rng.normal(size=(6, 3)), rng.normal(size=(6, 6)), rng.normal(size=6)
    np.testing.assert_allclose(product(a, b), a @ b)
    np.testing.assert_allclose(product(b.T, a.T), b.T @ a.T)
    np.testing.assert_allclose(applied(a, v), a @ v)
    assert squared(b, weight + weight.T) == pytest.approx(b.T @ (weight + weight.T) @ b)
