"""A real browser without a screen, led by its DevTools protocol.

playwright makes every page appear visible and focused, but the trials need hidden and unfocused
pages.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

from needle_core.errors import UserError

_FLAGS = """\
--headless=new --no-sandbox --no-first-run --disable-gpu --disable-quic --disable-sync
--disable-background-networking --disable-component-update --disable-extensions
--disable-breakpad --disable-dev-shm-usage --remote-debugging-port=0"""
_TIMEOUT = 60.0
_POLL = 0.02
_KEY = {"key": " ", "code": "Space", "windowsVirtualKeyCode": 32}


def chromium() -> str | None:
    """Return the path of the browser; None if Debian's package `chromium` is not installed."""
    return shutil.which("chromium")


class Chromium:
    """Separate browser process with an empty profile.

    Parameters
    ----------
    folder : Path
        New folder for its profile.

    Raises
    ------
    UserError
        If there is no browser, or it does not start.
    """

    def __init__(self, folder: Path) -> None:
        # Only trials with a browser need it.
        from websockets.sync.client import connect  # noqa: PLC0415

        path = chromium()
        if path is None:
            raise UserError("there is no chromium: apt-get install chromium")
        folder.mkdir()
        self._process = subprocess.Popen(
            [path, *_FLAGS.split(), f"--user-data-dir={folder}", "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._open = contextlib.ExitStack()
        self._open.callback(self.kill)
        try:
            port, endpoint = self._contents(folder / "DevToolsActivePort").split()
            self._socket = self._open.enter_context(
                connect(f"ws://127.0.0.1:{port}{endpoint}", compression=None, max_size=None)
            )
        except BaseException:
            self._open.close()
            raise
        self._numbers = itertools.count(1)

    def open(self, url: str) -> Tab:
        """Open a page in front, in a new tab."""
        target = str(self.call("Target.createTarget", url=url)["targetId"])
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        tab = Tab(self, target, str(session))
        tab.show()
        return tab

    def close_all_but(self, tab: Tab) -> None:
        """Close all pages but one, which comes to the front."""
        for target in self.call("Target.getTargets")["targetInfos"]:
            if target["type"] == "page" and target["targetId"] != tab.target:
                self.call("Target.closeTarget", targetId=target["targetId"])
        tab.show()

    def call(self, method: str, session: str = "", **parameters: object) -> dict[str, Any]:
        """Send a command and return its answer.

        Raises
        ------
        UserError
            If the browser refuses or does not answer.
        """
        number = self.post(method, session, **parameters)
        while True:
            try:
                answer = json.loads(self._socket.recv(timeout=_TIMEOUT))
            except TimeoutError as error:
                raise UserError(f"chromium does not answer {method}") from error
            if answer.get("id") == number:
                break
        if "error" in answer:
            raise UserError(f"chromium: {method}: {answer['error']['message']}")
        return dict(answer["result"])

    def post(self, method: str, session: str = "", **parameters: object) -> int:
        """Send a command without waiting; return its number."""
        number = next(self._numbers)
        command = {"id": number, "method": method, "params": parameters}
        self._socket.send(json.dumps({**command, "sessionId": session} if session else command))
        return number

    def kill(self) -> None:
        """Kill all of its processes at once."""
        # Only once: the process number may be reused later.
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def close(self) -> None:
        """End the browser."""
        # A browser that has ended does not answer: do not wait.
        self.kill()
        self._open.close()

    def _contents(self, file: Path) -> str:
        deadline = time.monotonic() + _TIMEOUT
        while True:
            with contextlib.suppress(FileNotFoundError):
                text = file.read_text("utf-8")
                if text.count("\n"):
                    return text
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise UserError("chromium does not start")
            time.sleep(_POLL)


class Tab:
    """A page of the browser.

    Parameters
    ----------
    browser : Chromium
        Browser of the page.
    target, session : str
        Identifiers of the page and of the connection to it.

    Attributes
    ----------
    target : str
        Identifier of the page.
    """

    def __init__(self, browser: Chromium, target: str, session: str) -> None:
        self._browser = browser
        self.target = target
        self._session = session

    def run(self, script: str) -> Any:
        """Run a script; return its result."""
        answer = self._browser.call(
            "Runtime.evaluate", self._session, expression=script, returnByValue=True
        )
        return answer["result"].get("value")

    def show(self) -> None:
        """Bring the page to the front."""
        self._browser.post("Target.activateTarget", targetId=self.target)

    def press_pointer(self, x: float, y: float) -> None:
        """Press the mouse button at a position [px]."""
        self._mouse("mouseMoved", x, y, 0)
        self._mouse("mousePressed", x, y, 1)

    def release_pointer(self, x: float, y: float) -> None:
        """Release the mouse button."""
        self._mouse("mouseReleased", x, y, 0)

    def press_other_button(self, x: float, y: float) -> None:
        """Press the other mouse button in addition to the first."""
        self._mouse("mousePressed", x, y, 3, "right")

    def touch(self, *places: tuple[float, float]) -> None:
        """Place fingers at these positions [px]; none: lift them."""
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(places)]
        self._input("Touch", type="touchStart" if points else "touchEnd", touchPoints=points)

    def cancel_touch(self) -> None:
        """Cancel the touch, as a system does that uses it for itself."""
        self._input("Touch", type="touchCancel", touchPoints=[])

    def press_key(self, key: str) -> None:
        """Press a key by its name."""
        self._input("Key", type="keyDown", key=key, code=key)

    def press_space(self, *, repeat: bool = False) -> None:
        """Press the space bar, or repeat it while it is pressed."""
        self._input("Key", type="keyDown", autoRepeat=repeat, **_KEY)

    def release_space(self) -> None:
        """Release the space bar."""
        self._input("Key", type="keyUp", **_KEY)

    def _mouse(self, kind: str, x: float, y: float, buttons: int, button: str = "left") -> None:
        button = "none" if kind == "mouseMoved" else button
        at = {"x": x, "y": y, "clickCount": 1}
        self._input("Mouse", type=kind, button=button, buttons=buttons, **at)

    def _input(self, device: str, **parameters: object) -> None:
        self._browser.post(f"Input.dispatch{device}Event", self._session, **parameters)
