"""The console's page in a real browser, on a simulated rig: display, steering, stop."""

from __future__ import annotations

import importlib.util
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest

CHROMIUM = "/usr/bin/chromium"
MISSING = [name for name in ("nicegui", "playwright") if importlib.util.find_spec(name) is None]
MISSING += [] if shutil.which(CHROMIUM) else ["chromium"]
if MISSING:
    pytest.skip(f"needs {', '.join(MISSING)}; .ci/run installs it", allow_module_level=True)

from playwright.sync_api import Page, expect, sync_playwright  # noqa: E402
from playwright.sync_api import TimeoutError as TooLate  # noqa: E402

# Without 3D, whose software rendering would take most of the CPU.
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
# Time-out of a condition [s].
LIMIT = 30.0
DEPTH = """() => parseFloat([...document.querySelectorAll(".reading")].find(
    (row) => row.querySelector(".name").textContent === "Depth"
).querySelector(".value").textContent.replace("\\u2212", "-"))"""
"""Returns the depth that the page shows [mm]."""

Hand = Callable[[], None]


def free_port() -> int:
    """Return the first of two consecutive free ports."""
    while True:
        with socket.socket() as page, socket.socket() as hold:
            page.bind(("127.0.0.1", 0))
            port = int(page.getsockname()[1])
            try:
                hold.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Yield the address of a console on a simulated rig; check its clean exit afterwards."""
    argv = ["--level", "tip", "--port", str(free_port())]
    with subprocess.Popen(
        [sys.executable, "-m", "needle_bringup.simulation.console", *argv],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as console:
        try:
            assert console.stdout is not None
            match = re.match(r"(\S+) ", console.stdout.readline())
            assert match
            yield match[1]
        finally:
            console.send_signal(signal.SIGINT)
            _, complaints = console.communicate(timeout=LIMIT)
    assert (console.returncode, complaints) == (130, "")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Return a separate browser."""
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
def page(browser: Any, address: str) -> Iterator[Page]:
    """Yield a page, ready to steer; an error of its scripts fails the last test."""
    opened = browser.new_page()
    errors: list[str] = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.goto(address)
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


def check_stands_still(page: Page) -> float:
    """Check that the needle does not move without a hold; return its depth [mm]."""
    expect(reading(page, "Device")).to_have_text("HOLDING")
    expect(page.locator("[data-hold=insert]")).not_to_have_text(re.compile("held"))
    # At rest, the rig exposes once a second: two new tips take at least a second.
    tip = reading(page, "Tip")
    expect(tip).not_to_have_text(tip.inner_text())
    at = float(page.evaluate(DEPTH))
    for _ in range(2):
        expect(tip).not_to_have_text(tip.inner_text())
        assert float(page.evaluate(DEPTH)) == at
    expect(reading(page, "Device")).to_have_text("HOLDING")
    return at


def hold_until(page: Page, press: Hand, release: Hand, headline: str) -> None:
    """Hold until the depth [mm] meets the condition, without a release.

    A browser that is delayed by 0.25 s on a busy machine loses the hold; the test then releases and
    presses again, as an operator would.
    """
    for _ in range(int(LIMIT)):
        press()
        try:
            page.wait_for_function(f"() => ({DEPTH})() {headline}", timeout=2e3)
        except TooLate:
            release()
        else:
            return
    raise AssertionError(f"the needle does not get there: {page.locator('main').inner_text()}")


def make_ready(page: Page) -> None:
    """Press the buttons in the advised order."""
    # Services answer only after simulated time has started.
    expect(reading(page, "Depth")).to_have_text("0.0 mm of 120 mm")
    for button, headline in (
        ("Confirm needle out", "Not homed"),
        ("Home", "Ready, switched off"),
        ("Enable", "Ready to steer"),
        ("Start steering", "Steering waits for you"),
    ):
        press(page, button)
        expect(page.locator(".headline")).to_have_text(headline)


def test_a_needle_is_steered_by_the_space_bar_and_stops_with_it(page: Page) -> None:
    # None of the buttons so far has moved the needle.
    assert check_stands_still(page) == 0.0
    page.evaluate("document.activeElement.blur()")
    space = page.keyboard
    hold_until(page, lambda: space.down("Space"), lambda: space.up("Space"), "> 3")
    space.up("Space")
    assert 3.0 < check_stands_still(page) < 10.0
    expect(reading(page, "Distance from plane")).to_contain_text("95 %")
    expect(reading(page, "Reach")).to_contain_text("can be reached")


def test_a_pointer_holds_and_stop_ends_it_until_a_new_press(page: Page) -> None:
    begin = check_stands_still(page)
    hold = page.locator("[data-hold=insert]")
    hold.hover()
    hold_until(page, page.mouse.down, page.mouse.up, f"> {begin + 1.0}")
    # Stop while the pointer is still down.
    page.evaluate("document.getElementById('stop').click()")
    at = check_stands_still(page)
    page.mouse.up()
    assert check_stands_still(page) == at


def test_another_page_can_watch_and_stop_but_not_move(
    page: Page, browser: Any, address: str
) -> None:
    page.locator("[data-hold=insert]").hover()
    begin = check_stands_still(page)
    other = browser.new_page()
    try:
        other.goto(address)
        # A browser throttles background pages, so bring the steering page to the front.
        page.bring_to_front()
        hold_until(page, page.mouse.down, page.mouse.up, f"> {begin + 0.5}")
        expect(other.locator("#hold-words")).to_have_text("another page steers")
        expect(other.get_by_role("button", name="Switch off")).to_be_disabled()
        expect(page.get_by_role("button", name="Switch off")).to_be_enabled()
        press(other, "Stop")
        # The device received the stop, whether or not the hold had ended before.
        expect(other.locator(".answer")).to_contain_text("device/stop: ")
        at = check_stands_still(other)
        other.locator("[data-hold=insert]").hover()
        other.mouse.down()
        assert check_stands_still(other) == at
        other.mouse.up()
    finally:
        other.close()
    page.mouse.up()


def test_a_target_is_changed_while_steering_and_invalid_input_is_rejected(page: Page) -> None:
    press(page, "Set point")
    expect(reading(page, "Reach")).to_contain_text("point")
    offset = page.get_by_label("Plane offset [mm]")
    offset.fill("80")
    press(page, "Set plane")
    expect(page.get_by_text("offset = 80 mm is outside [-50, 50] mm")).to_be_visible()
    offset.fill("4")
    press(page, "Set plane")
    expect(reading(page, "Reach")).to_contain_text("plane")


def test_the_needle_is_withdrawn_by_a_hold(page: Page) -> None:
    page.locator("[data-hold=retract]").hover()
    hold_until(page, page.mouse.down, page.mouse.up, "< 1")
    page.mouse.up()
    check_stands_still(page)
    expect(reading(page, "Controller")).to_have_text("IDLE")
