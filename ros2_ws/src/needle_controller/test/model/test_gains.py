"""Gains of (9) and (10) against scipy's solution of the Riccati equations."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import integrate, linalg

from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import A, B, C, transition
from needle_controller.model.gains import (
    Gains,
    design_gains,
    held_input_response,
    sampled_observer_gain,
)

STD = 0.001 / np.sqrt(3.0)
WEIGHTS: dict[str, Any] = {
    "state_weights": (1.0e6, 900.0, 0.1),
    "input_weight": 1.0e-4,
    "process_noise": (1e-7, 1e-3, 1.0),
    "measurement_std": STD,
    "step_length": 0.001,
}


def gains(**changes: Any) -> Gains:
    return design_gains(**{**WEIGHTS, **changes})


def observer_gain(found: Gains) -> Array:
    """Return L of (9), which gives A - L C the observer's poles."""
    return np.poly(found.observer_poles).real[1:]


def test_gains_solve_the_riccati_equations() -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        # In the units of s and of ds/dl.
        state_weights = rng.lognormal(size=3) * np.square([1e3, 30.0, 0.3])
        process_noise = rng.lognormal(size=3) * np.square([3e-4, 0.03, 1.0])
        found = gains(state_weights=tuple(state_weights), process_noise=tuple(process_noise))
        # In units of 20 mm, so that the solver's matrices are well scaled.
        units = np.array([50.0, 1.0, 0.02])
        scaled = np.diag(state_weights) / np.outer(units, units) * 0.02**4 / WEIGHTS["input_weight"]
        cost = linalg.solve_continuous_are(A, B, scaled, np.eye(1))
        np.testing.assert_allclose(found.feedback, cost[2] * units / 0.02**2, rtol=1e-9)
        scaled = np.diag(process_noise) * np.outer(units, units) * 0.02**4 / (STD**2 * 0.001)
        covariance = linalg.solve_continuous_are(A.T, C.T, scaled, np.eye(1))
        gain = covariance[0] / units / 0.02**2
        np.testing.assert_allclose(observer_gain(found), gain, rtol=1e-9)


def test_the_sampled_observer_keeps_the_poles_at_any_length_and_tends_to_9() -> None:
    design = gains()
    poles, lengths = design.observer_poles, [0.0, 1e-5, 1e-3, 0.05]
    for length in lengths:
        gain = np.array(sampled_observer_gain(poles, length))
        error = (np.eye(3) - gain[:, None] @ C) @ transition(length)
        expected = np.poly(np.exp(poles * length)).real
        np.testing.assert_allclose(np.poly(error).real, expected, atol=1e-12)
    assert sampled_observer_gain(poles, 0.0) == (0.0, 0.0, 0.0)
    shortest = np.array(sampled_observer_gain(poles, 1e-8)) / 1e-8
    np.testing.assert_allclose(shortest, observer_gain(design), rtol=1e-5)


def test_held_input_is_the_integral() -> None:
    def column(i: int) -> float:
        value, _ = integrate.quad(lambda at: (transition(0.02 - at) @ B)[i, 0], 0.0, 0.02)
        return float(value)

    np.testing.assert_allclose(held_input_response(0.02), [column(i) for i in range(3)], rtol=1e-10)
