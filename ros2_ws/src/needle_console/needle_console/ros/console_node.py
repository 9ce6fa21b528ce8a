"""The console's node: the rig into its picture, a person's wishes into messages."""

from __future__ import annotations

import contextlib
import queue
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from geometry_msgs.msg import PointStamped, PoseStamped

from needle_console.access.access import Access
from needle_console.hold.hold_state import OWNER, HoldState
from needle_console.hold.retraction import Retraction
from needle_console.page.desk import Desk
from needle_console.ros.console_parameters import ConsoleParameters
from needle_console.ros.rig_services import OF_BUTTON, STOP, RigServices
from needle_console.ros.rig_topics import RigTopics
from needle_console.view.advice import STEERING, Button
from needle_console.view.camera_feed import CameraFeed
from needle_console.view.rig_picture import RigPicture
from needle_console.view.snapshot import Array
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.files.installed import find_shared
from needle_core.messages import HOLD_LIFETIME
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher
from needle_core.ros.conversions import LATCHED, to_quaternion
from needle_core.ros.hold_topic import HoldTopic
from needle_core.ros.life_signs import LifeSigns
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.optics.refraction import stereo_views

_LOOK_PERIOD = 0.2
_HEALTH_PERIOD = 1.0


class Served(Protocol):
    """A server with a thread of its own."""

    def start(self) -> None:
        """Begin to serve."""

    def close(self) -> None:
        """End."""


class HoldServed(Served, Protocol):
    """Server of the hold."""

    @property
    def is_alive(self) -> bool:
        """Whether the hold is served."""

    def counts(self) -> dict[str, int]:
        """Return how often what was refused or lost."""


MakeHold = Callable[[Access, int, Callable[[HoldState], None], Callable[[str], None]], HoldServed]
"""Makes the hold's server: who may connect, its port, what takes the hold, and a notice."""

MakePage = Callable[[Desk, Access, ConsoleParameters, str], Served]
"""Makes the page's server: what pages do, who may open one, the parameters, the hold's token."""


class ConsoleNode(WholeNode):
    """Page, hold and rig, tied together.

    The page's server and the hold's each have a thread of their own; what they want of ROS is done
    by the node's, but for `device/hold`: that is published by the hold's thread, which waits for
    nobody.

    Parameters
    ----------
    make_hold : MakeHold
        Makes the server of the hold.
    make_page : MakePage
        Makes the server of the page.
    node_arguments : dict
        Passed on to rclpy's Node (a context of its own, parameter overrides).

    Raises
    ------
    UserError
        A parameter that cannot be, or a port that is taken.
    """

    def __init__(self, make_hold: MakeHold, make_page: MakePage, **node_arguments: Any) -> None:
        super().__init__("console", **node_arguments)
        values = NodeParameters(self, ConsoleParameters).values
        self._picture = RigPicture()
        self._retraction = Retraction()
        self._targets_wanted: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._diagnostics = DiagnosticsPublisher(self)
        self._hold_topic = HoldTopic(self, OWNER, HOLD_LIFETIME)
        self._planes = self.create_publisher(PoseStamped, "target_plane", LATCHED)
        self._points = self.create_publisher(PointStamped, "target_point", LATCHED)
        self._calls = RigServices(self, self._picture.see_answer)
        self._feed = CameraFeed(_cameras(values.calibration_file), self._picture.snapshot)
        self._topics = RigTopics(self, self._picture, self._feed)
        self._bell = self.create_guard_condition(self._send_targets)
        token = _token(values.token_file)
        hosts = [host for host in values.hosts if host]
        access = Access(values.address, values.port, token, hosts)
        self._hold = make_hold(access, values.hold_port, self._on_hold, self._on_notice)
        self._web = make_page(self._desk(), access, values, token)
        self.create_timer(_LOOK_PERIOD, self._look, clock=STEADY_CLOCK)
        self.create_timer(_HEALTH_PERIOD, self._tell_health, clock=STEADY_CLOCK)
        self._life = LifeSigns(
            self,
            self._diagnostics,
            f"page on http://{values.address}:{values.port}/",
            self._waits_for,
        )
        self._hold.start()
        self._web.start()

    def close(self) -> None:
        """Release the hold, then end both servers."""
        self._hold.close()
        self._web.close()

    def _desk(self) -> Desk:
        return Desk(
            name=OWNER,
            snapshot=lambda: self._picture.snapshot(time.monotonic()),
            picture=lambda side: self._feed.picture(side, time.monotonic()),
            press=self._press,
            stop=lambda: self._calls.ask(STOP),
            send_plane=self._send_plane,
            send_point=self._send_point,
        )

    def _press(self, button: Button) -> None:
        self._calls.ask(*OF_BUTTON[button])

    # ---- the hold's thread --------------------------------------------------------------------

    def _on_hold(self, state: HoldState) -> None:
        rig = self._picture.states()
        todo = self._retraction.update(
            state,
            time.monotonic(),
            steering=rig.controller is not None and rig.controller.state in STEERING,
            hold_counts=rig.device is not None
            and rig.device.hold_owner == OWNER
            and rig.device.activity == "none",
        )
        self._hold_topic.publish(pressed=todo.press, speed=state.speed)
        for service in todo.calls:
            self._calls.ask(service)

    def _on_notice(self, text: str) -> None:
        self.get_logger().warning(text)

    # ---- the page's thread --------------------------------------------------------------------

    def _send_plane(self, pose: Array) -> None:
        message = PoseStamped()
        message.header.frame_id = "rig"
        p = message.pose.position
        p.x, p.y, p.z = (float(part) for part in pose[:3, 3])
        message.pose.orientation = to_quaternion(pose[:3, :3].tolist())
        self._targets_wanted.put(lambda: self._planes.publish(message))
        self._bell.trigger()

    def _send_point(self, point: Array) -> None:
        # Placed by hand, and not seen at a time: no stamp.
        message = PointStamped()
        message.header.frame_id = "rig"
        message.point.x, message.point.y, message.point.z = (float(part) for part in point)
        self._targets_wanted.put(lambda: self._points.publish(message))
        self._bell.trigger()

    # ---- the node's thread --------------------------------------------------------------------

    def _send_targets(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                self._targets_wanted.get_nowait()()

    def _look(self) -> None:
        now = time.monotonic()
        self._topics.look(now)
        self._calls.look(now)

    def _tell_health(self) -> None:
        counts = {f"refused {reason}": str(count) for reason, count in self._hold.counts().items()}
        alive = self._hold.is_alive
        message = "served" if alive else "the hold's server has ended"
        level = Level.OK if alive else Level.ERROR
        self._diagnostics.set("hold", Diagnostic(level, message, counts))

    def _waits_for(self) -> list[str]:
        topics = ("device/status", "needle/controller_status")
        return [f"publisher of {topic}" for topic in topics if not self.count_publishers(topic)]


def _cameras(file: str) -> dict[str, Any]:
    path = (
        Path(file).expanduser()
        if file
        else find_shared("needle_tracker", "config/calibration.yaml")
    )
    left, right = stereo_views(load_calibration(path))
    return {"left": left, "right": right}


def _token(file: str) -> str:
    if not file:
        return ""
    try:
        lines = Path(file).expanduser().read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"token_file = {file!r} cannot be read: {error}") from error
    if not lines or not lines[0].strip():
        raise UserError(f"token_file = {file!r} has no first line")
    return lines[0].strip()
