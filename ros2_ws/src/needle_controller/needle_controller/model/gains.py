"""Gains of the law (10) and of the observer (9) from LQG weights ([KC09] III-B).

Both are designed on the system (8) in inserted length, as in the paper, for continuous time: the
weights then mean the same whatever the step. As (8) is a chain of integrators, the roots of a cubic
solve the Riccati equations. The law's gain is used as it is, after a check that holding the input
over one step keeps the loop stable. The observer is sampled exactly in its error: over any inserted
length l its error poles are exp(lambda_i l), lambda_i being those of A - L C. A discrete design
would give a gain for one step length only, while steps are shortened, aborted and resumed.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import A, C, transition
from needle_core.compiled import compiled
from needle_core.errors import UserError


@dataclasses.dataclass(frozen=True)
class Gains:
    """Gains that follow from the weights.

    Attributes
    ----------
    feedback : ndarray, shape (3,)
        K of (10): (1/m^3, 1/m^2, 1/m).
    observer : ndarray, shape (3,)
        L of (9) per inserted length: (1/m, 1/m^2, 1/m^3).
    observer_poles : ndarray of complex, shape (3,)
        Eigenvalues of A - L C [1/m].
    """

    feedback: Array
    observer: Array
    observer_poles: npt.NDArray[np.complex128]


def design_gains(
    *,
    state_weights: npt.ArrayLike,
    input_weight: float,
    process_noise: npt.ArrayLike,
    measurement_std: float,
    step_length: float,
) -> Gains:
    """Return the gains of law and observer.

    Parameters
    ----------
    state_weights : array_like, shape (3, 3)
        Cost of s per inserted length, symmetric, nonnegative.
    input_weight : float
        Cost of v per inserted length, > 0.
    process_noise : array_like, shape (3, 3)
        Covariance of white noise on ds/dl per metre, symmetric, nonnegative.
    measurement_std : float
        Standard deviation of one measurement of s1 [m], > 0; one measurement comes every
        `step_length`.
    step_length : float
        Insertion between measurements, over which the rotation rate is held [m], > 0.

    Returns
    -------
    Gains
        Both gains and the observer's poles.

    Raises
    ------
    UserError
        A weight that is not finite, symmetric or nonnegative, a pair of weights that leaves the
        system without a stabilising gain, or a step too long for the law.
    """
    state_weights = checked_weights("state_weights", state_weights)
    process_noise = checked_weights("process_noise", process_noise)
    for name, value in (
        ("input_weight", input_weight),
        ("measurement_std", measurement_std),
        ("step_length", step_length),
    ):
        if not (np.isfinite(value) and value > 0.0):
            raise UserError(f"{name} = {value:g} is not a finite number > 0")
    feedback = _feedback_gain(state_weights, input_weight)
    # A measurement every step_length carries as much as white noise of this density.
    density = measurement_std**2 * step_length
    observer = _observer_gain(process_noise, density)
    sampled = transition(step_length) - held_input(step_length)[:, None] @ feedback[None, :]
    radius = float(np.max(np.abs(np.linalg.eigvals(sampled))))
    if radius >= 1.0:
        raise UserError(
            f"the law is unstable when held over step_length = {step_length:g} m "
            f"(spectral radius {radius:.3g}, wants < 1): lower state_weights or step_length"
        )
    poles = np.linalg.eigvals(A - observer[:, None] @ C).astype(complex)
    return Gains(feedback, observer, poles)


@functools.lru_cache
def gains_by_diagonals(
    state_weights: tuple[float, ...],
    input_weight: float,
    process_noise: tuple[float, ...],
    measurement_std: float,
    step_length: float,
) -> Gains:
    """Return `design_gains` of diagonal weights, designed once however often it is asked for."""
    return design_gains(
        state_weights=np.diag(state_weights),
        input_weight=input_weight,
        process_noise=np.diag(process_noise),
        measurement_std=measurement_std,
        step_length=step_length,
    )


def held_input(length: float) -> Array:
    """Return G, what a unit input v held over an inserted length adds to s, shape (3,)."""
    return np.array([length**3 / 6.0, length**2 / 2.0, length])


@compiled
def sampled_observer_gain(
    poles: npt.NDArray[np.complex128], length: float
) -> tuple[float, float, float]:
    """Return the gain on one innovation after an inserted length, with unchanged error poles.

    With q_i = 1 - exp(lambda_i l) and e_k their elementary symmetric polynomials, the error (I -
    gain C) F(l) of the triple integrator has the poles exp(lambda_i l) for gain = (e1 - e2 + e3,
    (e2 - 3/2 e3) / l, e3 / l^2). For small l it tends to l L, with L of (9); after no insertion it
    is 0: a second look at a needle at rest, through the same optics, is not counted as new.

    Parameters
    ----------
    poles : ndarray of complex, shape (3,)
        Eigenvalues of A - L C [1/m].
    length : float
        Inserted length since the last correction, >= 0 [m].

    Returns
    -------
    tuple of float
        Gain on w - C s: (-, 1/m, 1/m^2).
    """
    if length == 0.0:
        return 0.0, 0.0, 0.0
    q1, q2, q3 = (
        -np.expm1(poles[0] * length),
        -np.expm1(poles[1] * length),
        -np.expm1(poles[2] * length),
    )
    e1 = (q1 + q2 + q3).real
    e2 = (q1 * q2 + q1 * q3 + q2 * q3).real
    e3 = (q1 * q2 * q3).real
    return e1 - e2 + e3, (e2 - 1.5 * e3) / length, e3 / length**2


def checked_weights(name: str, weights: npt.ArrayLike) -> Array:
    """Return weights as a 3 x 3 array.

    Raises
    ------
    UserError
        If they are not finite, symmetric and nonnegative definite, with the offending value.
    """
    matrix = np.asarray(weights, dtype=float)
    if matrix.shape != (3, 3):
        raise UserError(f"{name} has shape {matrix.shape}, wants (3, 3)")
    if not np.all(np.isfinite(matrix)):
        raise UserError(f"{name} = {matrix.tolist()} is not finite")
    largest = float(np.max(np.abs(matrix)))
    if float(np.max(np.abs(matrix - matrix.T))) > 1e-12 * largest:
        raise UserError(f"{name} = {matrix.tolist()} is not symmetric")
    smallest = float(np.min(np.linalg.eigvalsh(matrix)))
    if smallest < -1e-12 * largest:
        raise UserError(f"{name} has the eigenvalue {smallest:g}, wants >= 0")
    return matrix


def _feedback_gain(weights: Array, input_weight: float) -> Array:
    """Return K of (10) for the cost s^T weights s + input_weight v^2 per inserted length."""
    poles = _optimal_poles(weights / input_weight, "state_weights, input_weight")
    return np.real(np.poly(poles))[:0:-1]


def _observer_gain(process_noise: Array, measurement_density: float) -> Array:
    """Return L of (9), the steady Kalman gain for white process and measurement noise."""
    # The dual problem: the same chain of integrators, with its states in reverse.
    ratio = process_noise[::-1, ::-1] / measurement_density
    poles = _optimal_poles(ratio, "process_noise, measurement_std")
    return np.real(np.poly(poles))[1:]


def _optimal_poles(weights: Array, names: str) -> npt.NDArray[np.complex128]:
    """Return the stable half of the symmetric root locus of the triple integrator, shape (3,).

    By Kalman's equality, the closed loop's p(s) p(-s) is -s^6 + phi(-s)^T weights phi(s), with
    phi(s) = (1, s, s^2) and input weight 1: a cubic in s^2.
    """
    (q11, _, q13), (_, q22, _), (_, _, q33) = weights
    squares = np.roots([1.0, -q33, q22 - 2.0 * q13, -q11])
    poles: npt.NDArray[np.complex128] = -np.sqrt(squares.astype(complex))
    worst = float(np.max(poles.real))
    if not worst < 0.0:
        raise UserError(f"{names} give no stabilising gain (eigenvalue {worst:g}, wants < 0)")
    return poles
