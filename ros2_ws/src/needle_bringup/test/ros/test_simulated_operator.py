"""The stand-in as a process, against a rig that is played by the test."""

import signal
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.context import Context
from std_srvs.srv import SetBool, Trigger

from needle_core.process.ros_domain import own_domain
from needle_core.ros.conversions import LATCHED, to_nanoseconds
from operator_scene import OperatorScene, RigNode


class PlayedRig(RigNode):
    """Answers like sim_rig and plane_controller; remembers what was asked and held."""

    def __init__(self, context: Context, *, simulated: str = "true") -> None:
        super().__init__(context)
        self.simulated = simulated
        self.refusal = ""
        self.starts = 0
        self.mute: set[str] = set()
        for name in ("device/confirm_needle_out", "device/enable"):
            self._serve(SetBool, name)
        for name in ("device/home", "plane_controller/start"):
            self._serve(Trigger, name)
        self._controller = self.create_publisher(
            DiagnosticStatus, "needle/controller_status", LATCHED
        )
        self.tell_device(homed="true", state="DISABLED")
        self.tell_controller("IDLE", 0)

    def tell_device(self, **values: str) -> None:
        message = _status({"simulated": self.simulated, **values})
        message.hardware_id = self.get_name()
        self.device.publish(message)

    def tell_controller(self, state: str, step: int, reason: str = "") -> None:
        values = {"state": state, "step": str(step), "reason": reason}
        values |= {"starts": str(self.starts)}
        values |= {"insertion_m": str(step * 1e-3), "depth_m": "0.12"}
        self._controller.publish(_status(values))

    def _serve(self, kind: type[SetBool] | type[Trigger], name: str) -> None:
        service = self.create_service(kind, name, self._answer(name))
        send = service.send_response

        def send_unless_mute(response: object, header: object) -> None:
            # An answer is sent directly after the call to `answer`.
            if self.asked[-1] in self.mute:
                self.mute.remove(self.asked[-1])
            else:
                send(response, header)

        service.send_response = send_unless_mute

    def _answer(self, name: str) -> Callable[..., object]:
        def answer(request: object, response: object) -> object:
            data = getattr(request, "data", None)
            self.asked.append(name if data is None else f"{name} {data}")
            response.success = not self.refusal  # type: ignore[attr-defined]
            response.message = self.refusal  # type: ignore[attr-defined]
            if name == "device/home":
                self.tell_device(homed="true", state="MOVING")
                self.tell_device(homed="true", state="DISABLED")
            self.starts += name == "plane_controller/start"
            return response

        return answer


def _status(values: dict[str, str]) -> DiagnosticStatus:
    return DiagnosticStatus(values=[KeyValue(key=k, value=v) for k, v in values.items()])


class Scene(OperatorScene[PlayedRig]):
    """The stand-in before a played rig."""

    def __init__(self, domain: int, simulated: str = "true") -> None:
        super().__init__(domain, partial(PlayedRig, simulated=simulated), "simulated_operator")

    def end(self) -> tuple[int, str]:
        self.until(lambda: self.operator.poll() is not None)
        assert self.operator.stderr is not None
        return self.operator.returncode, self.operator.stderr.read()


@pytest.fixture
def scene(request: pytest.FixtureRequest) -> Iterator[Scene]:
    simulated = getattr(request, "param", "true")
    with own_domain() as domain, closing(Scene(domain, simulated)) as one:
        yield one


STARTED = [
    "device/confirm_needle_out True",
    "device/home",
    "device/enable True",
    "plane_controller/start",
]


def test_prepares_holds_until_done_releases_and_disables(scene: Scene) -> None:
    rig = scene.rig
    scene.until(lambda: rig.asked == STARTED)
    assert not any(hold.buttons[0] for hold in rig.holds), "a press from before would not count"
    scene.until(lambda: rig.holds)
    rig.tell_controller("STEERING", 1)
    scene.until(lambda: rig.holds[-1].buttons[0])
    released = len(rig.holds) - 1
    scene.until(lambda: len(rig.holds) >= released + 10)
    stamps = [to_nanoseconds(hold.header.stamp) for hold in rig.holds]
    assert stamps == sorted(set(stamps))
    (sender,) = {hold.header.frame_id for hold in rig.holds}
    assert sender.startswith("simulated_operator/")
    assert all(hold.buttons[0] == 1 and hold.axes[0] == 1.0 for hold in rig.holds[released:])
    rig.tell_controller("DONE", 120)
    code, said = scene.end()
    assert code == 0, said
    assert rig.holds[-1].buttons[0] == 0
    assert rig.asked == [*STARTED, "device/enable False"]
    assert "inserted 120.0 mm in 120 steps" in said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_releases_and_disables_before_the_end(scene: Scene, number: int) -> None:
    rig = scene.rig
    scene.until(lambda: rig.asked == STARTED)
    rig.tell_controller("STEERING", 1)
    scene.until(lambda: rig.holds)
    scene.operator.send_signal(number)
    code, said = scene.end()
    assert code == 130
    assert rig.holds[-1].buttons[0] == 0
    assert rig.asked[-1] == "device/enable False"
    assert "interrupted" in said


def test_a_fault_ends_it_with_the_reason_in_one_line(scene: Scene) -> None:
    rig = scene.rig
    scene.until(lambda: rig.asked == STARTED)
    rig.tell_controller("FAULT", 7, "the needle is gone")
    code, said = scene.end()
    assert code == 1
    lines = [line for line in said.strip().splitlines() if not line.startswith("[INFO]")]
    assert lines == ["simulated_operator: plane_controller FAULT: the needle is gone"]


@pytest.mark.parametrize("prepared", [True, False])
def test_a_signal_while_a_failed_run_is_put_away_counts_as_one(
    scene: Scene, prepared: bool
) -> None:
    rig = scene.rig
    # The stand-in waits for the answer that does not come while the signal comes.
    rig.mute = {"device/enable False"}
    if prepared:
        scene.until(lambda: rig.asked == STARTED)
        rig.tell_controller("FAULT", 7, "the device is gone")
    else:
        scene.until(lambda: "device/home" in rig.asked)
        rig.refusal = "the device is gone"
    scene.until(lambda: rig.asked[-1] == "device/enable False")
    scene.operator.send_signal(signal.SIGINT)
    code, said = scene.end()
    assert code == 130, said
    assert "the device is gone" in said


@pytest.mark.parametrize("mute", STARTED)
def test_an_answer_that_is_lost_is_asked_for_again(scene: Scene, mute: str) -> None:
    rig = scene.rig
    rig.mute = {mute}
    scene.until(lambda: "plane_controller/start" in rig.asked)
    rig.tell_controller("STEERING", 1)
    scene.until(lambda: rig.holds)
    rig.tell_controller("DONE", 120)
    code, said = scene.end()
    assert code == 0, said
    assert not rig.mute
    assert list(dict.fromkeys(rig.asked)) == [*STARTED, "device/enable False"]
    if mute in (STARTED[0], STARTED[2]):
        assert rig.asked.count(mute) == 2
    else:
        assert rig.asked.count("plane_controller/start") == 1


def test_a_refusal_ends_it_without_a_hold(scene: Scene) -> None:
    scene.rig.refusal = "the door is open"
    code, said = scene.end()
    assert code == 2
    assert "the door is open" in said
    assert not any(hold.buttons[0] for hold in scene.rig.holds)


@pytest.mark.parametrize("scene", ["false"], indirect=True)
def test_a_real_device_is_asked_for_nothing(scene: Scene) -> None:
    code, said = scene.end()
    assert code == 2
    assert "played_rig is a real device" in said
    assert scene.rig.asked == []
    assert not scene.rig.holds


def test_a_second_device_ends_it_by_name(scene: Scene) -> None:
    rig = scene.rig
    scene.until(lambda: rig.asked == STARTED)
    rig.tell_controller("STEERING", 1)
    scene.until(lambda: rig.holds)
    second = rclpy.create_node("device_driver", context=scene.context, namespace="")
    second.create_publisher(DiagnosticStatus, "device/status", LATCHED)
    code, said = scene.end()
    second.destroy_node()
    assert code == 1
    assert "more than one device" in said
    assert "device_driver" in said
    assert rig.holds[-1].buttons[0] == 0
