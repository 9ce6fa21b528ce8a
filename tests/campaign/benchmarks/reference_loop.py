"""The paper's loop for one needle in plain Python, as a reference for `scripts/bench`.

Plant [KC09] (1)-(2), observer (9) and law (10) with floats and the `math` module, and the same loop
as systems of python-control.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

State = tuple[float, ...]
Linear = tuple[float, float, float]

ENTRY_ROTATION = 9


class Design(NamedTuple):
    """Gains and limits of observer and law; see `needle_controller`."""

    curvature: float
    step: float
    feedback: State
    observer: State
    saturation_margin: float
    demand_margin: float
    max_rotation: float


def plant_start(x: float, pitch: float, roll: float) -> State:
    """Return the plant's state at insertion 0: rotation matrix by rows, then position."""
    cp, sp, cr, sr = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
    return (cp * cr, -cp * sr, sp, sr, cr, 0.0, -sp * cr, sp * sr, cp, x, 0.0, 0.0)


def plant_step(state: Sequence[float], design: Design, turn: float) -> State:
    """Return the plant's state after a step, which is one screw motion."""
    length = design.step
    bend = design.curvature * length
    square = bend * bend + turn * turn
    angle = math.sqrt(square)
    first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    third = (1.0 - first) / square
    e = (
        (1.0 - second * turn * turn, -first * turn, second * bend * turn),
        (first * turn, 1.0 - second * square, -first * bend),
        (second * bend * turn, first * bend, 1.0 - second * bend * bend),
    )
    along = (third * bend * turn, -second * bend, 1.0 - third * bend * bend)
    rotation, position = [], []
    for row in range(3):
        r = state[3 * row : 3 * row + 3]
        rotation += [sum(r[k] * e[k][column] for k in range(3)) for column in range(3)]
        position.append(
            state[ENTRY_ROTATION + row] + length * sum(r[k] * along[k] for k in range(3))
        )
    return (*rotation, *position)


def saturate(s: Linear, design: Design, margin: float) -> Linear:
    """Return s, saturated to the region of (6)."""
    squared = s[1] ** 2 + (s[2] / design.curvature) ** 2
    if squared <= 1.0 - margin:
        return s
    scale = math.sqrt((1.0 - margin) / squared)
    return (s[0], s[1] * scale, s[2] * scale)


def roll_of(s: Linear, design: Design) -> float:
    """Return the roll of s, the inverse of (6)."""
    sine = s[2] / design.curvature
    return math.atan2(sine, math.sqrt(1.0 - s[1] ** 2 - sine**2))


def observer_step(s: Linear, design: Design, turn: float, measured: float) -> Linear:
    """Return the observer's state after a step and the measurement that follows it."""
    length, curvature = design.step, design.curvature
    roll, pitch = roll_of(s, design), math.asin(s[1])
    turned = roll + turn - curvature * math.cos(roll) * math.tan(pitch) * length
    turned = min(max(turned, -0.5 * math.pi), 0.5 * math.pi)
    pitched = s[1] + length * s[2]
    added = curvature * math.sqrt(1.0 - pitched**2) * math.sin(turned) - s[2]
    moved = (
        s[0] + length * s[1] + length**2 * (0.5 * s[2] + added / 6.0),
        s[1] + length * (s[2] + 0.5 * added),
        s[2] + added,
    )
    moved = saturate(moved, design, design.saturation_margin)
    innovation = measured - moved[0]
    a, b, c = (
        value + gain * innovation for value, gain in zip(moved, design.observer, strict=True)
    )
    return saturate((a, b, c), design, design.saturation_margin)


def law_turn(s: Linear, design: Design) -> float:
    """Return the rotation of the base over the next step [rad]."""
    length = design.step
    v = -sum(gain * value for gain, value in zip(design.feedback, s, strict=True))
    demanded = (s[0], s[1] + length * s[2] + 0.5 * length**2 * v, s[2] + length * v)
    demanded = saturate(demanded, design, design.demand_margin)
    roll = roll_of(s, design)
    drift = -design.curvature * math.cos(roll) * math.tan(math.asin(s[1])) * length
    limit = design.max_rotation * length
    return min(max(roll_of(demanded, design) - roll - drift, -limit), limit)


def steer(start: Sequence[float], noise: Sequence[float], design: Design) -> float:
    """Steer one needle with one step per noise value [m]; return its last x [m]."""
    plant = plant_start(*start)
    s = (plant[9] + noise[0], 0.0, 0.0)
    turn = law_turn(s, design)
    for error in noise[1:]:
        plant = plant_step(plant, design, turn)
        s = observer_step(s, design, turn, plant[9] + error)
        turn = law_turn(s, design)
    return plant_step(plant, design, turn)[9]


def control_system(design: Design) -> Any:
    """Return the same loop as an interconnected system of python-control.

    The input is the measurement noise, the output x. The states are twelve of the needle, s, the
    last turn, and 1 after the first measurement.
    """
    import control  # noqa: PLC0415  (it takes a second to import)

    def corrected(state: Any, measured: float) -> Linear:
        if state[4] == 0.0:
            return (float(measured), 0.0, 0.0)
        return observer_step(
            (state[0], state[1], state[2]), design, float(state[3]), float(measured)
        )

    def update(_t: float, state: Any, u: Any, _p: Any) -> list[float]:
        s = corrected(state, u[0] + u[1])
        return [*s, law_turn(s, design), 1.0]

    def output(_t: float, state: Any, u: Any, _p: Any) -> list[float]:
        return [law_turn(corrected(state, u[0] + u[1]), design)]

    needle = control.nlsys(
        lambda _t, state, u, _p: list(plant_step(tuple(state), design, float(u[0]))),
        lambda _t, state, _u, _p: [state[9]],
        inputs=["turn"],
        outputs=["x"],
        states=12,
        dt=True,
        name="needle",
    )
    controller = control.nlsys(
        update, output, inputs=["tip", "noise"], outputs=["turn"], states=5, dt=True, name="law"
    )
    return control.interconnect(
        [needle, controller],
        connections=[["needle.turn", "law.turn"], ["law.tip", "needle.x"]],
        inplist=["law.noise"],
        outlist=["needle.x"],
        inputs=["noise"],
        outputs=["x"],
    )


def control_steer(system: Any, start: Sequence[float], noise: Sequence[float]) -> float:
    """Simulate `control_system` for one needle; return its last x [m]."""
    import control  # noqa: PLC0415

    response = control.input_output_response(
        system,
        np.arange(len(noise) + 1),
        np.array([[*noise, 0.0]]),
        np.array([*plant_start(*start), 0.0, 0.0, 0.0, 0.0, 0.0]),
    )
    return float(np.ravel(response.outputs)[-1])
