"""Riccati: a discrete linear system and its weights -> the covariance or cost and the LQR gain.

SciPy solves the equation, as it does for python-control's `dlqr` and `dlqe`; importing that library
would delay the start of every flight.
"""

import numpy as np

from falconwing_kit.core.checks import Array


def lqr_gain(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Gain K (m, n) of u = -K x that minimises sum x'Qx + u'Ru of x[k+1] = A x[k] + B u[k].

    K = (R + B'PB)^-1 B'PA                          [Astrom & Wittenmark 1997, sec. 11.4]

    Args:
        A: (n, n).
        B: (n, m).
        Q: (n, n) weight of the states.
        R: (m, m) weight of the control inputs.

    Raises:
        LinAlgError, ValueError: no gain stabilises the system.
    """
    P = riccati_solution(A, B, Q, R)
    return np.asarray(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), np.float64)


def predicted_covariance(A: Array, C: Array, Q: Array, R: Array) -> Array:
    """Covariance P (n, n) of the stationary Kalman filter's prediction, before a measurement.

    The dual of the regulator: A' for A, C' for B  [Astrom & Wittenmark 1997, sec. 11.3].

    Args:
        A: (n, n).
        C: (p, n) of the measurement.
        Q: (n, n) covariance of the process noise.
        R: (p, p) of the measurement's.
    """
    return riccati_solution(A.T, C.T, Q, R)


def riccati_solution(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """P (n, n) of P = A'PA - A'PB (R + B'PB)^-1 B'PA + Q, by SciPy."""
    from scipy.linalg import solve_discrete_are

    return np.asarray(solve_discrete_are(A, B, Q, R), np.float64)
