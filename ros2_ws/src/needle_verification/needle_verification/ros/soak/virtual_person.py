"""The person at the rig: prepares it, inserts, mends what a fault left, draws the needle out."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import Joy
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from needle_core.ros.conversions import HOLD, LATCHED, RELIABLE, values_of
from needle_verification.ros.soak.virtual_node import VirtualNode
from needle_verification.soak.faults import CONSOLE
from needle_verification.soak.virtual_page import VirtualPage
from needle_verification.soak.virtual_world import NANOSECONDS

INSERT, RETRACT, STOP = 0, 1, 2
_LOOK = 0.1
_JOY_RATE = 50.0
# Between two calls of one service [ns].
_CALL_AGAIN_NS = 500_000_000
# How long a finger stays off before it presses again [ns].
_PAUSE_NS = 300_000_000
# A needle that is in no farther looks as if it were out [m].
OUT = 3e-4


class Wish(enum.Enum):
    """Aim of the person."""

    INSERT = "insert"
    DRAW_OUT = "draw out"
    LEAVE = "leave"


@dataclasses.dataclass
class Hand:
    """Buttons that are down.

    Attributes
    ----------
    insert, retract, stop : bool
        Each of them.
    """

    insert: bool = False
    retract: bool = False
    stop: bool = False

    @property
    def holds(self) -> bool:
        """Whether it presses what could move the needle."""
        return self.insert or self.retract

    @property
    def button(self) -> str:
        """The button of a page that a finger is on; empty: none, or more than one."""
        if self.insert is self.retract or self.stop:
            return ""
        return "insert" if self.insert else "retract"


class Joystick(VirtualNode):
    """Publishes what the hand does.

    Parameters
    ----------
    hand : Hand
        The person's.
    """

    def __init__(self, hand: Hand) -> None:
        super().__init__("joy_node")
        self._hand = hand
        self._joy = self.create_publisher(Joy, "joy", HOLD)
        self.create_timer(1.0 / _JOY_RATE, self._tell)

    def _tell(self) -> None:
        hand = self._hand
        joy = Joy(buttons=[int(hand.insert), int(hand.retract), int(hand.stop)])
        joy.header.stamp = self.get_clock().now().to_msg()
        self._joy.publish(joy)


class Person(VirtualNode):
    """Acts by what the rig says of itself, and by where the needle is seen to be.

    Parameters
    ----------
    hand : Hand
        Its own.
    insertion : callable
        Returns how far the needle is in, as anybody can see [m].

    Attributes
    ----------
    wish : Wish
        What it wants now.
    device, controller : dict
        Key-values that they said last.
    done : bool
        Whether the controller has said once that it is done.
    absent : bool
        Whether it minds nothing, whatever its hand does.
    page : VirtualPage or None
        Where it holds, if not at the joystick.
    """

    def __init__(self, hand: Hand, insertion: Callable[[], float]) -> None:
        super().__init__("person")
        self._hand = hand
        self._insertion = insertion
        self.wish = Wish.INSERT
        self.device: dict[str, str] = {}
        self.controller: dict[str, str] = {}
        self.done = False
        self.absent = False
        self.page: VirtualPage | None = None
        self._called_ns: dict[str, int] = {}
        self._off_since_ns = 0
        self.create_subscription(DiagnosticStatus, "device/status", self._see_device, LATCHED)
        self.create_subscription(
            DiagnosticStatus, "needle/controller_status", self._see_controller, LATCHED
        )
        self.estop = self.create_publisher(Bool, "device/estop", RELIABLE)
        self._switches = {
            name: self.create_client(SetBool, f"device/{name}")
            for name in ("enable", "confirm_needle_out")
        }
        self._triggers = {
            name: self.create_client(Trigger, name)
            for name in (
                "device/home",
                "device/reset",
                "device/retract",
                "device/stop",
                "plane_controller/start",
                "plane_controller/stop",
            )
        }
        self.create_timer(_LOOK, self._look)

    def call(self, name: str, on: bool | None = None) -> None:
        """Call a service, without waiting for its answer."""
        if on is None:
            self._triggers[name].call_async(Trigger.Request())
        else:
            self._switches[name].call_async(SetBool.Request(data=on))

    @property
    def source(self) -> str:
        """Name of the node by which it holds, as the device knows it."""
        return "operator" if self.page is None else CONSOLE

    @property
    def _now_ns(self) -> int:
        return self.place.graph.world.steady_ns

    def _see_device(self, message: DiagnosticStatus) -> None:
        self.device = values_of(message)

    def _see_controller(self, message: DiagnosticStatus) -> None:
        self.controller = values_of(message)
        self.done = self.done or self.controller.get("state") == "DONE"

    def _look(self) -> None:
        if self.absent:
            return
        state = self.device.get("state", "")
        insert, retract = False, False
        if state in ("FAULT", "ESTOPPED"):
            if state == "ESTOPPED":
                self.estop.publish(Bool(data=False))
            self._try("device/reset")
        elif state == "DISABLED":
            self._prepare()
        elif state in ("HOLDING", "MOVING"):
            insert, retract = self._wanted(state)
        self._press(insert=insert, retract=retract)

    def _prepare(self) -> None:
        is_out = self._insertion() < OUT
        if self.device.get("homed") == "true" or not is_out:
            if self.wish is not Wish.LEAVE:
                self._try("enable", True)
        elif self.device.get("needle_out_confirmed") != "true":
            self._try("confirm_needle_out", True)
        else:
            self._try("device/home")

    def _wanted(self, state: str) -> tuple[bool, bool]:
        """Return whether to press to insert, and to draw out."""
        activity = self.device.get("activity", "")
        if activity == "homing":
            return False, False
        is_out = self._insertion() < OUT
        steering = self.controller.get("state", "")
        homed = self.device.get("homed") == "true"
        if self.wish is Wish.INSERT and homed:
            if steering in ("STEERING", "WAITING_FOR_TIP"):
                return True, False
            if is_out and steering in ("IDLE", "DONE", "FAULT") and not self.done:
                self._try("plane_controller/start")
                return False, False
        if not is_out and self.wish is not Wish.LEAVE:
            return False, True
        if state == "HOLDING" and is_out and not homed:
            # Homing is for axes that are off.
            self._try("enable", False)
        if is_out and (self.done or self.wish is Wish.DRAW_OUT):
            self.wish = Wish.LEAVE
        return False, False

    def _press(self, *, insert: bool, retract: bool) -> None:
        """Let go of what is not wanted; press what is, from neutral, anew where asked to."""
        hand = self._hand
        unheeded = self.device.get("press_again") == self.source
        if self.page is not None:
            unheeded = unheeded or self.page.asks_for_a_new_press
        stale = hand.holds and (insert, retract) != (hand.insert, hand.retract)
        if hand.holds and (stale or unheeded):
            self._let_go()
            return
        held_ns = self._now_ns - self._off_since_ns
        if hand.holds and not stale:
            # Who holds in vain lets go after a while, and tries again.
            if held_ns > 3 * NANOSECONDS and not self._is_served():
                self._let_go()
            return
        if (insert or retract) and held_ns > _PAUSE_NS:
            hand.insert, hand.retract = insert, retract
            self._off_since_ns = self._now_ns

    def _is_served(self) -> bool:
        return self.device.get("hold_owner") == self.source

    def _let_go(self) -> None:
        self._hand.insert = self._hand.retract = False
        self._off_since_ns = self._now_ns

    def _try(self, name: str, on: bool | None = None) -> None:
        if self._now_ns - self._called_ns.get(name, -_CALL_AGAIN_NS) >= _CALL_AGAIN_NS:
            self._called_ns[name] = self._now_ns
            self.call(name, on)
