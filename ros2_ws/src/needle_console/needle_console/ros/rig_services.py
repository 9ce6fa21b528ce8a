"""Services that the console calls for a person, and what they answer."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from needle_console.view.advice import Button

STOP = "device/stop"
# Service -> what it is sent; None: it takes no argument.
OF_BUTTON: dict[Button, tuple[str, bool | None]] = {
    Button.CONFIRM: ("device/confirm_needle_out", True),
    Button.HOME: ("device/home", None),
    Button.ENABLE: ("device/enable", True),
    Button.SWITCH_OFF: ("device/enable", False),
    Button.START: ("plane_controller/start", None),
    Button.RESET: ("device/reset", None),
}
_TRIGGERS = (STOP, "device/retract", "plane_controller/stop")
# So long an answer is waited for [s].
_PATIENCE = 2.0
_MOST_WAITING = 50


class RigServices:
    """Calls from any thread, made by the node's own.

    Parameters
    ----------
    node : Node
        Who calls.
    tell : callable
        Takes what was answered, in words.
    """

    def __init__(self, node: Node, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._wanted: queue.Queue[tuple[str, bool | None]] = queue.Queue(_MOST_WAITING)
        self._pending: dict[Future[Any], tuple[str, float]] = {}
        kinds = {name: Trigger if data is None else SetBool for name, data in OF_BUTTON.values()}
        self._clients: dict[str, Client[Any, Any]] = {
            name: node.create_client(kind, name)
            for name, kind in {**kinds, **dict.fromkeys(_TRIGGERS, Trigger)}.items()
        }
        self._bell = node.create_guard_condition(self._call_wanted)

    def ask(self, service: str, data: bool | None = None) -> None:
        """Have a service called soon; returns at once."""
        try:
            self._wanted.put_nowait((service, data))
        except queue.Full:
            self._tell(f"{service}: not called, {_MOST_WAITING} calls wait")
        self._bell.trigger()

    def look(self, now: float) -> None:
        """Give up calls that have not been answered."""
        for future, (service, asked_at) in list(self._pending.items()):
            if now - asked_at > _PATIENCE:
                del self._pending[future]
                self._clients[service].remove_pending_request(future)
                self._tell(f"{service}: no answer")

    def _call_wanted(self) -> None:
        while True:
            try:
                service, data = self._wanted.get_nowait()
            except queue.Empty:
                return
            client = self._clients[service]
            if not client.service_is_ready():
                self._tell(f"{service}: no server is there")
                continue
            request = Trigger.Request() if data is None else SetBool.Request(data=data)
            future = client.call_async(request)
            self._pending[future] = service, time.monotonic()
            future.add_done_callback(partial(self._take, service))

    def _take(self, service: str, future: Future[Any]) -> None:
        self._pending.pop(future, None)
        answer = future.result()
        if answer is not None:
            refused = "" if answer.success else "refused: "
            self._tell(f"{service}: {refused}{answer.message}")
