"""Eigenvalues are raised where they are too low, and nothing else is changed."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.graph.covariances import positive_definite, raised


@pytest.mark.parametrize("least", [0.0, 1e-3, 0.7])
def test_raising_is_that_of_the_eigenvalues(least: float) -> None:
    rng = np.random.default_rng(0)
    turns = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]
    values = rng.uniform(-1.0, 2.0, (200, 3))
    values[:50] = np.abs(values[:50]) + 1.0  # some need no raising
    symmetric = (turns * values[:, None, :]) @ turns.swapaxes(1, 2)
    expected = (turns * np.maximum(values, least)[:, None, :]) @ turns.swapaxes(1, 2)
    np.testing.assert_allclose(raised(symmetric, least), expected, atol=1e-12)


def test_a_singular_covariance_becomes_positive_definite() -> None:
    assert np.linalg.eigvalsh(positive_definite(np.diag([1.0, 0.0, -1e-9])[None])).min() > 0.0
