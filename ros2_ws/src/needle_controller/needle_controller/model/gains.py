"""Gains of the law (10) and of the observer (9) from LQG weights ([KC09] III-B).

Both are designed for the continuous system (8) in inserted length, as in the paper, so the weights
do not depend on the step length. As (8) is a chain of integrators, the roots of a cubic solve the
Riccati equations. The law's gain is used unchanged, after a check that the loop is stable with the
input held over one step. The observer's error is sampled exactly: over any inserted length l its
poles are exp(lambda_i l), where lambda_i are those of A - L C. A discrete design would give a gain
for one step length only, but steps are shortened, aborted and resumed.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import transition
from needle_core.compiled import compiled
from needle_core.errors import UserError


@dataclasses.dataclass(frozen=True)
class Gains:
    """Gains that follow from the weights.

    Attributes
    ----------
    feedback : ndarray, shape (3,)
        K of (10): (1/m^3, 1/m^2, 1/m).
    observer_poles : ndarray of complex, shape (3,)
        Eigenvalues of A - L C, L of (9) [1/m].
    """

    feedback: Array
    observer_poles: npt.NDArray[np.complex128]


@functools.lru_cache
def design_gains(
    *,
    state_weights: tuple[float, ...],
    input_weight: float,
    process_noise: tuple[float, ...],
    measurement_std: float,
    step_length: float,
) -> Gains:
    """Return the gains of law and observer.

    Parameters
    ----------
    state_weights : tuple of float, length 3
        Cost of s1^2, s2^2, s3^2 per inserted length, >= 0.
    input_weight : float
        Cost of v^2 per inserted length.
    process_noise : tuple of float, length 3
        Variances of white noise on ds/dl per metre, >= 0.
    measurement_std : float
        Standard deviation of one measurement of s1 [m], > 0; there is one every `step_length`.
    step_length : float
        Insertion between measurements, over which the rotation rate is held [m], > 0.

    Returns
    -------
    Gains
        The law's gain and the observer's poles.

    Raises
    ------
    UserError
        Weights without a stabilising gain, or a step that is too long for the law.
    """
    if not input_weight > 0.0:
        raise UserError(f"input_weight = {input_weight:g} is not a finite number > 0")
    # K, for the cost s^T weights s + input_weight v^2
    weights = np.array(state_weights) / input_weight
    feedback = np.real(np.poly(_optimal_poles(weights, "state_weights, input_weight")))[:0:-1]
    # Poles with the steady Kalman gain: the dual problem has the states of the chain in reverse.
    # One measurement every step_length is equivalent to white noise of this density.
    noise = np.array(process_noise)[::-1] / (measurement_std**2 * step_length)
    observer_poles = _optimal_poles(noise, "process_noise, measurement_std")
    sampled = (
        transition(step_length) - held_input_response(step_length)[:, None] @ feedback[None, :]
    )
    radius = float(np.max(np.abs(np.linalg.eigvals(sampled))))
    if radius >= 1.0:
        raise UserError(
            f"the law is unstable when held over step_length = {step_length:g} m "
            f"(spectral radius {radius:.3g}, must be < 1): lower state_weights or step_length"
        )
    return Gains(feedback, observer_poles)


def held_input_response(length: float) -> Array:
    """Return G, the change of s by a unit input v held over an inserted length, shape (3,)."""
    return np.array([length**3 / 6.0, length**2 / 2.0, length])


@compiled
def sampled_observer_gain(
    poles: npt.NDArray[np.complex128], length: float
) -> tuple[float, float, float]:
    """Return the gain on one innovation after an inserted length, with unchanged error poles.

    With q_i = 1 - exp(lambda_i l) and e_k their elementary symmetric polynomials, the error (I -
    gain C) F(l) of the triple integrator has the poles exp(lambda_i l) for gain = (e1 - e2 + e3,
    (e2 - 3/2 e3) / l, e3 / l^2). For small l it tends to l L, with L of (9). Without insertion it
    is 0: a second image of a needle at rest, through the same optics, adds no information.

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
    q = -np.expm1(poles * length)
    q1, q2, q3 = q[0], q[1], q[2]
    e1 = (q1 + q2 + q3).real
    e2 = (q1 * q2 + q1 * q3 + q2 * q3).real
    e3 = (q1 * q2 * q3).real
    return e1 - e2 + e3, (e2 - 1.5 * e3) / length, e3 / length**2


def _optimal_poles(weights: Array, names: str) -> npt.NDArray[np.complex128]:
    """Return the stable half of the symmetric root locus of the triple integrator, shape (3,).

    By Kalman's equality, the closed loop's p(s) p(-s) is -s^6 + sum_i weights_i |phi_i(s)|^2 with
    phi(s) = (1, s, s^2) and input weight 1: a cubic in s^2.
    """
    q1, q2, q3 = weights
    squares = np.roots([1.0, -q3, q2, -q1])
    poles: npt.NDArray[np.complex128] = -np.sqrt(squares.astype(complex))
    worst = float(np.max(poles.real))
    if not worst < 0.0:
        raise UserError(f"{names} give no stabilising gain (eigenvalue {worst:g}, must be < 0)")
    return poles
