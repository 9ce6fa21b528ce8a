"""Simulated rig around the step protocol, and helpers for its tests."""

from __future__ import annotations

from collections.abc import Callable

from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import Action, Awaiting, SendStep, SteeringState
from needle_controller.protocol.continuous import make_steering
from needle_controller.protocol.joint_history import JointSample
from needle_core.component import Log
from needle_core.messages import Point
from needle_core.status_messages import DeviceStatus

TICK = 20_000_000
SECOND = 10**9
ENOUGH = 5
"""Number of good tips that must suffice for a recovery."""


def device(state: str, homed: bool = True, owner: str = "", reason: str = "") -> DeviceStatus:
    """Return a device/status."""
    return DeviceStatus(state=state, homed=homed, hold_owner=owner, reason=reason)


HOLD = device("HOLDING", owner="operator")
MOVING = device("MOVING", owner="operator")
FREE = device("HOLDING")


class Rig:
    """Simulated rig: joints, tips and answers, on its own clock."""

    def __init__(
        self,
        *,
        depth: float = 0.12,
        started: bool = True,
        held: bool = True,
        tip_covariance: str = "configured",
        preset: str = "best",
        insertion: float = 0.0,
        rotation: float = 0.0,
        insertion_mode: str = "stepwise",
    ) -> None:
        self.steering = make_steering(
            SteeringSettings(
                preset=preset,
                depth=depth,
                target_offset=0.003,
                tip_covariance=tip_covariance,
                insertion=insertion_mode,
            )
        )
        self.now = TICK
        self.insertion = insertion
        self.rotation = rotation
        self.steering.on_device(HOLD if held else FREE)
        self.joints()
        if started:
            assert self.start() == "steering"

    def start(self) -> str:
        """Request a start; return the reply, "steering" on success."""
        reply, actions = self.steering.on_start()
        assert reply.success == (reply.message == "steering")
        assert reply.message in logged(actions)
        return reply.message

    def joints(self) -> list[Action]:
        return self.steering.on_joints(JointSample(self.now, self.insertion, self.rotation))

    def settle(self, count: int = 6) -> list[Action]:
        """Send several joint samples of the present position."""
        actions: list[Action] = []
        for _ in range(count):
            self.now += TICK
            actions += self.joints()
        return actions

    def measured(self, x: float = 0.0, ahead: int = 0) -> Point:
        """Return a tip of the present position, with a stamp `ahead` ns from now."""
        return Point(self.now + ahead, "rig", (x, 0.0, self.insertion))

    def expose(self, tip: Point | None = None, x: float = 0.0) -> list[Action]:
        """Advance by one tick: send joints, then the tip."""
        self.now += TICK
        actions = self.joints()
        return actions + self.steering.on_tip(tip or self.measured(x))

    def run(self, step: SendStep, part: float = 1.0, text: str = "succeeded") -> list[Action]:
        """Execute a part of a step, and answer."""
        start = self.insertion, self.rotation
        for share in (0.5 * part, part):
            self.now += TICK
            self.go_to(start, step, share)
            self.joints()
        return self.steering.on_result(step.stamp_ns, text)

    def go_to(self, start: tuple[float, float], step: SendStep, share: float) -> None:
        """Move to a share of the way from joint positions to the end of a step."""
        self.insertion = start[0] + share * (step.insertion - start[0])
        self.rotation = start[1] + share * (step.rotation - start[1])

    def withdraw(self) -> list[Action]:
        """Move the needle out in steps of 0.5 mm."""
        actions: list[Action] = []
        while self.insertion > 0.0:
            self.insertion = max(self.insertion - 0.0005, 0.0)
            actions += self.settle(1)
        return actions + self.settle()

    def steps(self, count: int) -> None:
        for _ in range(count):
            self.run(sent(self.expose()))

    def good_tips(self, most: int = ENOUGH) -> SendStep:
        """Expose good tips until one leads to a step."""
        for _ in range(most):
            actions = self.expose()
            if not none_sent(actions):
                return sent(actions)
        raise AssertionError(f"{most} good tips, no step: {state_of(self)} {self.steering.reason}")


def sent(actions: list[Action]) -> SendStep:
    steps = [action for action in actions if isinstance(action, SendStep)]
    assert len(steps) == 1, actions
    return steps[0]


def none_sent(actions: list[Action]) -> bool:
    return not any(isinstance(action, SendStep) for action in actions)


def logged(actions: list[Action]) -> str:
    return "; ".join(action.text for action in actions if isinstance(action, Log))


def state_of(rig: Rig) -> tuple[SteeringState, Awaiting]:
    return rig.steering.state, rig.steering.awaiting


def spied(
    rig: Rig, patch: Callable[[object, str, object], None], method: str
) -> list[tuple[object, ...]]:
    """Return a list that collects the arguments of further calls of the estimator."""
    calls: list[tuple[object, ...]] = []
    estimator = rig.steering.control._estimator
    original = getattr(estimator, method)

    def spy(*arguments: object) -> None:
        calls.append(arguments)
        original(*arguments)

    patch(estimator, method, spy)
    return calls
