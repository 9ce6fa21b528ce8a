"""The console's page in a real browser, on a simulated rig: seen, steered, stopped."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

from needle_core.process.reach import DISCOVERY_RANGE
from needle_core.ros.conversions import JOINT_STATES, LATCHED, values_of

CHROMIUM = "/usr/bin/chromium"
MISSING = [name for name in ("nicegui", "playwright") if importlib.util.find_spec(name) is None]
MISSING += [] if shutil.which(CHROMIUM) else ["chromium"]
if MISSING:
    pytest.skip(f"needs {', '.join(MISSING)}; .ci/run installs it", allow_module_level=True)

from playwright.sync_api import Page, expect, sync_playwright  # noqa: E402

# Without 3D: drawn by the processor, the needle in space would cost more than all else.
FLAGS = [
    "--disable-3d-apis",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
# Until what is awaited has come [s].
LIMIT = 30.0
# Half a second of joint_states.
STANDS = 25


def free_port() -> int:
    """Return a port that is free, as is the next one."""
    while True:
        with socket.socket() as page, socket.socket() as hold:
            page.bind(("127.0.0.1", 0))
            port = int(page.getsockname()[1])
            try:
                hold.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port


class Heard:
    """What a rig's joints, device and controller say, heard by a thread of its own."""

    def __init__(self, domain: int) -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._heard = threading.Condition()
        self._count = 0
        self._insertion = float("nan")
        self._node = Node("listening_test", context=self._context)
        self._node.create_subscription(JointState, "joint_states", self._take, JOINT_STATES)
        self._told: dict[str, str] = {}
        self._device: dict[str, str] = {}
        self._node.create_subscription(
            DiagnosticStatus, "device/status", self._take_device, LATCHED
        )
        self._node.create_subscription(
            DiagnosticStatus, "needle/controller_status", self._take_status, LATCHED
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._ended = False
        self._thread.start()

    def comes(self, condition: Callable[[float], bool], limit: float) -> bool:
        """Wait until a condition of the insertion [m] holds; tell whether it did in time [s]."""
        with self._heard:
            return self._heard.wait_for(lambda: condition(self._insertion), limit)

    def next_ones(self, count: int) -> list[float]:
        """Return the insertions [m] of the next `count` messages."""
        found = []
        with self._heard:
            for _ in range(count):
                until = self._count + 1
                assert self._heard.wait_for(partial(self._has_heard, until), LIMIT)
                found.append(self._insertion)
        return found

    def _has_heard(self, count: int) -> bool:
        return self._count >= count

    def told(self) -> dict[str, str]:
        """Return what the controller has said last."""
        with self._heard:
            return self._told

    def close(self) -> None:
        self._ended = True
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        while not self._ended:
            self._executor.spin_once(timeout_sec=0.1)

    def wait_for_word(self, key: str, text: str) -> None:
        """Wait until the controller's status says so."""
        with self._heard:
            assert self._heard.wait_for(lambda: self._told.get(key) == text, LIMIT), self._told

    def wait_until_let_go(self) -> None:
        """Wait until nobody's hold counts and the device is ready, as it is between steps too."""
        with self._heard:
            assert self._heard.wait_for(self._is_let_go, LIMIT), self._device

    def _is_let_go(self) -> bool:
        return self._device.get("state") == "HOLDING" and self._device["hold_owner"] == ""

    def _take_device(self, message: DiagnosticStatus) -> None:
        with self._heard:
            self._device = values_of(message)
            self._heard.notify_all()

    def _take_status(self, message: DiagnosticStatus) -> None:
        with self._heard:
            self._told = values_of(message)
            self._heard.notify_all()

    def _take(self, message: JointState) -> None:
        with self._heard:
            self._insertion = message.position[list(message.name).index("insertion_joint")]
            self._count += 1
            self._heard.notify_all()


Hand = Callable[[], None]


class Rig(NamedTuple):
    """A simulated rig with a console on it."""

    address: str
    heard: Heard


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    """Return a console on a simulated rig; all ends in order afterwards."""
    port = free_port()
    command = ["-m", "needle_bringup.simulation.console", "--level", "tip", "--port", str(port)]
    with subprocess.Popen(
        [sys.executable, *command],
        env={**os.environ, DISCOVERY_RANGE: "OFF"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as console:
        try:
            assert console.stdout is not None
            said = re.match(r"(\S+) .*ROS_DOMAIN_ID (\d+)", console.stdout.readline())
            assert said
            heard = Heard(int(said[2]))
            yield Rig(said[1], heard)
            heard.close()
        finally:
            console.send_signal(signal.SIGINT)
            _, complaints = console.communicate(timeout=LIMIT)
    # With it, no page would ever have shown a needle.
    named = f"{DISCOVERY_RANGE}=OFF ignored: with it, no node finds another\n"
    assert (console.returncode, complaints) == (130, named)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Return a browser of its own."""
    with sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            str(tmp_path_factory.mktemp("profile")),
            executable_path=CHROMIUM,
            args=FLAGS,
            viewport={"width": 1280, "height": 720},
        )
        context.set_default_timeout(LIMIT * 1e3)
        expect.set_options(timeout=LIMIT * 1e3)
        yield context
        context.close()


@pytest.fixture(scope="module")
def page(browser: Any, rig: Rig) -> Iterator[Page]:
    """Return a page, ready to steer; what its scripts complain of fails the last test."""
    opened = browser.new_page()
    errors: list[str] = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.goto(rig.address)
    expect(opened.locator(".kind")).to_have_text("SIMULATED")
    make_ready(opened)
    yield opened
    opened.close()
    assert errors == []


def reading(page: Page, name: str) -> Any:
    row = page.locator(".reading", has=page.locator(".name", has_text=re.compile(f"^{name}$")))
    return row.locator(".value")


def press(page: Page, name: str) -> None:
    page.get_by_role("button", name=name).click()


def check_stands_still(rig: Rig, page: Page) -> float:
    """Fail unless the needle stays where it is once nobody holds; return where [m]."""
    rig.heard.wait_until_let_go()
    expect(reading(page, "Device")).to_have_text("HOLDING")
    places = rig.heard.next_ones(STANDS)
    assert max(places) - min(places) < 1e-6
    return places[-1]


def hold_until(rig: Rig, press: Hand, let_go: Hand, wanted: Callable[[float], bool]) -> None:
    """Hold until the insertion [m] is as wanted, and on: only the test lets go.

    A browser that a busy machine keeps waiting for 0.25 s loses the hold; as a person would, the
    test then lets go and presses anew.
    """
    for _ in range(int(LIMIT)):
        press()
        if rig.heard.comes(wanted, 1.0):
            return
        let_go()
    raise AssertionError(f"the needle does not get there: {rig.heard.told()}")


def make_ready(page: Page) -> None:
    """Press the buttons in their order, as the page advises."""
    # Before time has started, nobody answers.
    expect(reading(page, "Depth")).to_have_text("0.0 mm of 120 mm")
    for button, wanted in (
        ("Confirm needle out", "Not homed"),
        ("Home", "Ready, switched off"),
        ("Enable", "Ready to steer"),
        ("Start steering", "Steering waits for you"),
    ):
        press(page, button)
        expect(page.locator(".headline")).to_have_text(wanted)


def test_a_needle_is_steered_by_the_space_bar_and_stops_with_it(rig: Rig, page: Page) -> None:
    # Not one of the buttons on the way here has moved it.
    assert check_stands_still(rig, page) == pytest.approx(0.0, abs=1e-6)
    page.evaluate("document.activeElement.blur()")
    space = page.keyboard
    hold_until(rig, lambda: space.down("Space"), lambda: space.up("Space"), lambda at: at > 3e-3)
    space.up("Space")
    at = check_stands_still(rig, page)
    expect(reading(page, "Depth")).to_have_text(f"{at * 1e3:.1f} mm of 120 mm")
    expect(reading(page, "Off the plane")).to_contain_text("95 %")
    expect(reading(page, "Reach")).to_contain_text("can be reached")


def test_a_pointer_holds_and_stop_ends_it_until_a_new_press(rig: Rig, page: Page) -> None:
    begin = check_stands_still(rig, page)
    hold = page.locator("[data-hold=insert]")
    hold.hover()
    hold_until(rig, page.mouse.down, page.mouse.up, lambda at: at > begin + 1e-3)
    # As by another hand: the pointer is still down.
    page.evaluate("document.getElementById('stop').click()")
    check_stands_still(rig, page)
    page.mouse.up()
    check_stands_still(rig, page)


def test_another_page_sees_and_can_stop_but_not_move(rig: Rig, page: Page, browser: Any) -> None:
    page.locator("[data-hold=insert]").hover()
    begin = check_stands_still(rig, page)
    other = browser.new_page()
    try:
        other.goto(rig.address)
        # Who steers looks at their page: one that lies behind gets less of the processor.
        page.bring_to_front()
        hold_until(rig, page.mouse.down, page.mouse.up, lambda at: at > begin + 5e-4)
        expect(other.locator("#hold-words")).to_have_text("another page steers")
        expect(other.get_by_role("button", name="Switch off")).to_be_disabled()
        expect(page.get_by_role("button", name="Switch off")).to_be_enabled()
        press(other, "Stop")
        # Whether the first page's hold had ended before or not, the device was told.
        expect(other.locator(".answer")).to_contain_text("device/stop: ")
        check_stands_still(rig, other)
        other.locator("[data-hold=insert]").hover()
        other.mouse.down()
        check_stands_still(rig, other)
        other.mouse.up()
    finally:
        other.close()
    page.mouse.up()


def test_a_target_is_changed_in_the_middle_and_nonsense_is_refused(rig: Rig, page: Page) -> None:
    press(page, "Set point")
    rig.heard.wait_for_word("target_point_m", "0.01, -0.005, 0.1")
    expect(reading(page, "Reach")).to_contain_text("point")
    offset = page.get_by_label("Plane offset [mm]")
    offset.fill("80")
    press(page, "Set plane")
    expect(page.get_by_text("offset = 80 mm is outside [-50, 50] mm")).to_be_visible()
    offset.fill("4")
    press(page, "Set plane")
    rig.heard.wait_for_word("target_offset_m", "0.004")
    rig.heard.wait_for_word("target_point_m", "")


def test_the_needle_is_drawn_out_by_a_hold_too(rig: Rig, page: Page) -> None:
    page.locator("[data-hold=retract]").hover()
    hold_until(rig, page.mouse.down, page.mouse.up, lambda at: at < 1e-3)
    page.mouse.up()
    check_stands_still(rig, page)
    expect(reading(page, "Controller")).to_have_text("IDLE")
