from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import integrate, linalg

from needle_controller.model.feedback_linearization import A, B, C, process_covariance, transition
from needle_controller.model.gains import Gains, design_gains, held_input, sampled_observer_gain
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.errors import UserError

STD = 0.001 / np.sqrt(3.0)
WEIGHTS: dict[str, Any] = {
    "state_weights": np.diag([1.0e6, 900.0, 0.1]),
    "input_weight": 1.0e-4,
    "process_noise": np.diag([1e-7, 1e-3, 1.0]),
    "measurement_std": STD,
    "step_length": 0.001,
}


def gains(**changes: Any) -> Gains:
    return design_gains(**{**WEIGHTS, **changes})


def test_feedback_satisfies_its_riccati_equation() -> None:
    """The cost of K from a Lyapunov equation must solve the Riccati equation."""
    k = gains().feedback[None, :]
    q, r = WEIGHTS["state_weights"], WEIGHTS["input_weight"]
    closed = A - B @ k
    assert np.max(np.linalg.eigvals(closed).real) < 0.0
    cost = linalg.solve_continuous_lyapunov(closed.T, -(q + r * k.T @ k))
    np.testing.assert_allclose(B.T @ cost / r, k, rtol=1e-6)
    np.testing.assert_allclose(
        A.T @ cost + cost @ A - cost @ B @ B.T @ cost / r + q, 0.0, atol=1e-6 * np.max(q)
    )


def test_poles_are_the_stable_ones_of_the_hamiltonian() -> None:
    """An independent way to the closed loop's eigenvalues."""
    q, r = WEIGHTS["state_weights"], WEIGHTS["input_weight"]
    hamiltonian = np.block([[A, -B @ B.T / r], [-q, -A.T]])
    expected = [z for z in np.linalg.eigvals(hamiltonian) if z.real < 0.0]
    found = np.linalg.eigvals(A - B @ gains().feedback[None, :])
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(expected), rtol=1e-6)
    noise, density = WEIGHTS["process_noise"], STD**2 * 0.001
    hamiltonian = np.block([[A.T, -C.T @ C / density], [-noise, -A]])
    expected = [z for z in np.linalg.eigvals(hamiltonian) if z.real < 0.0]
    np.testing.assert_allclose(
        np.sort_complex(gains().observer_poles), np.sort_complex(expected), rtol=1e-6
    )


@pytest.mark.parametrize("seed", range(5))
def test_gains_are_those_of_the_riccati_equations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-0.5, 0.5, (3, 1))
    # Weights and noise that are not diagonal; rows in the units of s and of ds/dl.
    state_weights = (root @ root.T) * np.outer([1e3, 30.0, 0.3], [1e3, 30.0, 0.3])
    process_noise = (root @ root.T) * np.outer([3e-4, 0.03, 1.0], [3e-4, 0.03, 1.0])
    found = gains(state_weights=state_weights, process_noise=process_noise)
    # In units of 20 mm, so that the solver's matrices are well scaled.
    units = np.array([50.0, 1.0, 0.02])
    scaled = state_weights / np.outer(units, units) * 0.02**4 / WEIGHTS["input_weight"]
    cost = linalg.solve_continuous_are(A, B, scaled, np.eye(1))
    np.testing.assert_allclose(found.feedback, cost[2] * units / 0.02**2, rtol=1e-9)
    scaled = process_noise * np.outer(units, units) * 0.02**4 / (STD**2 * 0.001)
    covariance = linalg.solve_continuous_are(A.T, C.T, scaled, np.eye(1))
    np.testing.assert_allclose(found.observer, covariance[0] / units / 0.02**2, rtol=1e-9)


def test_observer_is_near_the_discrete_kalman_gain() -> None:
    """For slow poles, sampling the continuous design and designing for the samples agree."""
    slow = gains(process_noise=np.diag([1e-9, 1e-6, 1e-3]))
    f = transition(0.001)
    noise = process_covariance(np.diag([1e-9, 1e-6, 1e-3]), 0.001)
    p = linalg.solve_discrete_are(f.T, C.T, noise, [[STD**2]])
    kalman = (p @ C.T)[:, 0] / (p[0, 0] + STD**2)
    np.testing.assert_allclose(sampled_observer_gain(slow.observer_poles, 0.001), kalman, rtol=0.05)


@pytest.mark.parametrize("length", [1e-5, 3e-4, 1e-3, 5e-3, 0.05])
def test_sampled_observer_keeps_the_poles_at_any_length(length: float) -> None:
    poles = gains().observer_poles
    gain = sampled_observer_gain(poles, length)
    error = (np.eye(3) - gain[:, None] @ C) @ transition(length)
    np.testing.assert_allclose(
        np.sort(np.abs(np.linalg.eigvals(error))),
        np.sort(np.abs(np.exp(poles * length))),
        rtol=1e-3,
    )
    expected = np.poly(np.exp(poles * length)).real
    np.testing.assert_allclose(np.poly(error).real, expected, atol=1e-12)


def test_sampled_observer_tends_to_9_and_vanishes_without_insertion() -> None:
    design = gains()
    np.testing.assert_allclose(
        sampled_observer_gain(design.observer_poles, 1e-8) / 1e-8, design.observer, rtol=1e-5
    )
    np.testing.assert_array_equal(sampled_observer_gain(design.observer_poles, 0.0), 0.0)
    many = sampled_observer_gain(design.observer_poles, np.array([0.0, 1e-3, 2e-3]))
    for length, row in zip((0.0, 1e-3, 2e-3), many, strict=True):
        # Not to the last bit: numpy may round whole arrays and single numbers differently.
        one = sampled_observer_gain(design.observer_poles, length)
        np.testing.assert_allclose(row, one, rtol=1e-13)


def test_held_input_is_the_integral() -> None:
    def column(i: int) -> float:
        value, _ = integrate.quad(lambda at: (transition(0.02 - at) @ B)[i, 0], 0.0, 0.02)
        return float(value)

    np.testing.assert_allclose(held_input(0.02), [column(i) for i in range(3)], rtol=1e-10)


def test_the_defaults_are_stable_in_steps() -> None:
    parameters = SteeringSettings()
    design = parameters.gains()
    length = parameters.step_length
    law = transition(length) - np.outer(held_input(length), design.feedback)
    assert np.max(np.abs(np.linalg.eigvals(law))) < 1.0
    assert np.max(design.observer_poles.real) < 0.0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"state_weights": np.diag([1.0, np.nan, 1.0])}, "not finite"),
        ({"state_weights": np.diag([1.0, np.inf, 1.0])}, "not finite"),
        ({"state_weights": np.diag([1.0, -2.0, 1.0])}, "-2"),
        ({"state_weights": [[1, 2, 0], [0, 1, 0], [0, 0, 1]]}, "not symmetric"),
        ({"state_weights": np.eye(2)}, r"\(3, 3\)"),
        ({"process_noise": [[1, 2, 0], [2, 1, 0], [0, 0, 1]]}, "-1"),
        ({"process_noise": np.zeros((3, 3))}, "process_noise"),
        ({"state_weights": np.zeros((3, 3))}, "state_weights"),
        ({"input_weight": 0.0}, "input_weight = 0"),
        ({"input_weight": np.nan}, "input_weight"),
        ({"measurement_std": -1.0}, "measurement_std"),
        ({"step_length": 0.0}, "step_length"),
        ({"step_length": 0.05}, "unstable"),
    ],
)
def test_bad_weights_are_refused_with_what_and_why(change: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        gains(**change)
