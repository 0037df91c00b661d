"""Riccati: by hand for one state, and its equations for two."""

import numpy as np
import pytest

from falconwing_kit.control.riccati import lqr_gain, predicted_covariance

ONE = np.eye(1)


def test_gain_of_one_state_by_hand():
    """x[k+1] = x + u with weights of one: P = 1 + P / (1 + P), so P is the golden ratio 1.618 and
    K = P / (1 + P) = 0.618.
    """
    assert lqr_gain(ONE, ONE, ONE, ONE) == pytest.approx(np.array([[0.6180339887]]), rel=1e-9)


def test_covariance_of_one_state_by_hand():
    """The dual: P = 1 + P / (1 + P)."""
    P = predicted_covariance(ONE, ONE, ONE, ONE)
    assert pytest.approx(np.array([[1.6180339887]]), rel=1e-9) == P


def test_filter_is_not_the_regulator():
    """Transposes matter: x1' = x1 + x2, x1 measured. Its equations hold for P, by insertion."""
    A, C = np.array([[1.0, 1.0], [0.0, 0.9]]), np.array([[1.0, 0.0]])
    Q, R = np.diag([0.1, 0.2]), np.array([[0.5]])
    P = predicted_covariance(A, C, Q, R)
    gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    assert A @ (P - gain @ C @ P) @ A.T + Q == pytest.approx(P, rel=1e-8)
