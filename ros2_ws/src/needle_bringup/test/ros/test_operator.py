"""The operator as a process, with a joystick's topic before it and a rig played by the test."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.context import Context
from sensor_msgs.msg import Joy
from std_srvs.srv import Trigger

from needle_bringup.operator.controls import Controls
from needle_bringup.operator.parameters import OperatorParameters
from needle_core.errors import UserError
from needle_core.process.ros_domain import own_domain
from needle_core.ros.conversions import RELIABLE, to_nanoseconds
from operator_scene import OperatorScene, RigNode

INSERT, RETRACT, STOP = 0, 1, 2
SERVICES = ("device/stop", "device/retract", "plane_controller/stop")
PARAMETERS = {
    "source": "joy",
    "key": INSERT,
    "retract_key": RETRACT,
    "stop_key": STOP,
    "speed_axis": 0,
    "speed_scale": 0.5,
}


class PlayedRig(RigNode):
    """Sends a joystick's state, answers like driver and controller, keeps what was held."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.down: set[int] = set()
        self.silent = False
        for name in SERVICES:
            self.create_service(Trigger, name, self._answer(name))
        self._joy = self.create_publisher(Joy, "joy", RELIABLE)
        self.create_timer(0.02, self._send)

    def tell(self, **values: str) -> None:
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        self.device.publish(DiagnosticStatus(values=pairs))

    def _send(self) -> None:
        if not self.silent:
            buttons = [int(button in self.down) for button in range(3)]
            self._joy.publish(Joy(axes=[0.6], buttons=buttons))

    def _answer(self, name: str) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            self.asked.append(name)
            response.success = True
            return response

        return answer


class Scene(OperatorScene[PlayedRig]):
    """The operator before a played rig."""

    def __init__(self, domain: int) -> None:
        words = [word for name, value in PARAMETERS.items() for word in ("-p", f"{name}:={value}")]
        super().__init__(domain, PlayedRig, "operator", "--ros-args", *words)

    def is_held(self) -> bool:
        return bool(self.rig.holds[-1].buttons[0])

    def after(self, count: int) -> None:
        """Wait until so many more messages of the hold were heard."""
        wanted = len(self.rig.holds) + count
        self.until(lambda: len(self.rig.holds) >= wanted)


@pytest.fixture
def scene() -> Iterator[Scene]:
    with own_domain() as domain, closing(Scene(domain)) as one:
        yield one


def test_a_joystick_inserts_retracts_and_stops_until_it_falls_silent(scene: Scene) -> None:
    rig = scene.rig
    # Pressed from the start on: it does not count.
    rig.down = {INSERT}
    scene.until(lambda: len(rig.holds) > 15)
    assert not any(hold.buttons[0] for hold in rig.holds)
    rig.down = set()
    scene.after(5)
    rig.down = {INSERT}
    scene.until(scene.is_held)
    held = rig.holds[-1]
    assert held.header.frame_id.startswith("operator/")
    # Half of 1.6 / 2 of the axis' way; and what a message promises.
    assert list(held.axes) == pytest.approx([0.4, 0.1])
    stamps = [to_nanoseconds(hold.header.stamp) for hold in rig.holds]
    assert stamps == sorted(set(stamps))
    rig.down = {INSERT, STOP}
    scene.until(lambda: not scene.is_held())
    scene.until(lambda: rig.asked == ["device/stop"])
    rig.down = {INSERT}
    scene.after(10)
    assert not any(hold.buttons[0] for hold in rig.holds[-8:])
    rig.down = set()
    scene.after(5)
    # Drawn out: the controller is stopped before anything is held.
    rig.down = {RETRACT}
    scene.until(scene.is_held)
    assert rig.asked == ["device/stop", "plane_controller/stop"]
    rig.tell(hold_owner="operator", activity="none")
    scene.until(lambda: rig.asked[-1] == "device/retract")
    rig.tell(hold_owner="operator", activity="retraction")
    scene.after(5)
    assert scene.is_held()
    rig.tell(hold_owner="operator", activity="none")
    scene.until(lambda: not scene.is_held())
    rig.down = set()
    scene.after(5)
    rig.down = {INSERT}
    scene.until(scene.is_held)
    rig.silent = True
    scene.until(lambda: not scene.is_held())
    rig.silent = False
    scene.after(10)
    assert not any(hold.buttons[0] for hold in rig.holds[-8:])
    assert len(rig.asked) == 3


def test_a_signal_releases_what_is_held(scene: Scene) -> None:
    rig = scene.rig
    scene.until(lambda: len(rig.holds) > 15)
    rig.down = {INSERT}
    scene.until(scene.is_held)
    scene.operator.send_signal(signal.SIGTERM)
    scene.until(lambda: scene.operator.poll() is not None)
    scene.until(lambda: not scene.is_held())
    assert scene.operator.returncode == 0


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"source": "joy"}, "key = -1"),
        ({"key": 48}, "device = ''"),
        ({"key": 48, "device": "/dev/input/x", "speed_axis": 2}, "a pedal has none"),
        ({"key": 48, "device": "/dev/input/x", "stop_key": 48}, "not all different"),
        ({"key": 48, "device": "/dev/input/x", "axis_at_zero": 1.0}, "are both 1.0"),
        ({"key": 4800, "device": "/dev/input/x"}, "key"),
        ({"key": 48, "device": "/dev/input/x", "source": "terminal"}, "source"),
    ],
)
def test_what_nobody_could_hold_is_refused(values: dict[str, object], said: str) -> None:
    with pytest.raises(UserError, match=said):
        OperatorParameters(**values)  # type: ignore[arg-type]


def test_a_key_that_is_not_named_is_none() -> None:
    parameters = OperatorParameters(key=48, device="/dev/input/x")
    assert parameters.controls == Controls(insert=48)
