"""Setting of a trial of the console: rig, console, browser, a way to press, a hand that steers."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

from campaign.trials.console.button_page import BUTTON
from campaign.trials.console.chromium import Chromium, Tab
from campaign.trials.console.console_hand import ConsoleHand
from campaign.trials.console.stalling_proxy import StallingProxy
from campaign.trials.trial_processes import Parameters, TrialProcesses
from needle_console.hold.hold_state import OWNER
from needle_core.errors import UserError

_DEEPEST = 0.45
_TRIES = 50
# From a press to the first motion [s].
_START = 1.0
_LOOK = 0.005
_STATE = "document.documentElement.dataset.holdState"


class Scene:
    """A rig, the console's stand-in, a browser, and a hand that orders steps.

    Parameters
    ----------
    folder : Path
        Takes profiles and logs.
    domain : int
        ROS_DOMAIN_ID.

    Attributes
    ----------
    rng : random.Random
        Of moments and ways to press.
    by : str
        What was pressed last: pointer, touch or space.
    """

    def __init__(self, folder: Path, domain: int) -> None:
        self.rng = random.Random(0)
        self.by = "pointer"
        self._folder = folder
        self._profiles = 0
        self._open = contextlib.ExitStack()
        try:
            self.hand = self._open.enter_context(closing(ConsoleHand()))
            self._open.enter_context(closing(TrialProcesses(folder, domain, _rig())))
            self.console = self._open.enter_context(closing(_Console(folder, domain)))
            self.proxy = self._open.enter_context(
                closing(StallingProxy(self.console.ports["hold"]))
            )
            self.browser = self._browser()
            self.tab = self.page()
            self.hand.prepare()
        except BaseException:
            self.close()
            raise

    def page(self) -> Tab:
        """Open the page in front, and wait until it is connected."""
        port = self.console.ports["page"]
        tab = self.browser.open(f"http://127.0.0.1:{port}/?port={self.proxy.port}")
        self.wait_for_page(tab)
        return tab

    def restart_browser(self) -> None:
        """Start a new browser with the page."""
        self.browser.close()
        self.browser = self._browser()
        self.tab = self.page()

    def wait_for_page(self, tab: Tab) -> None:
        """Wait until a press on the page would count."""
        self.hand.until(lambda: tab.run(_STATE) in ("ready", "again"), "the page is connected")

    def press_until(self, seconds: float) -> int:
        """Press anew, until a hold has moved the needle for so long [s].

        Returns
        -------
        int
            How often a hold ended by itself meanwhile: a busy machine is late more often than the
            hold's protocol allows.
        """
        if self.hand.insertion > _DEEPEST:
            raise UserError(f"the needle is {self.hand.insertion * 1e3:.0f} mm deep")
        for tries in range(_TRIES):
            self.release()
            self.wait_for_page(self.tab)
            self.by = self.rng.choice(("pointer", "touch", "space"))
            if self.by == "pointer":
                self.tab.press_pointer(*BUTTON)
            elif self.by == "touch":
                self.tab.touch(BUTTON)
            else:
                self.tab.press_space()
            if self._moves(seconds):
                return tries
        raise UserError(f"no hold lasted for {seconds:.1f} s in {_TRIES} presses")

    def _moves(self, seconds: float) -> bool:
        """Wait until the needle has moved for so long [s]; return whether it did."""
        seen = len(self.hand.moves)
        end = time.monotonic() + _START
        while len(self.hand.moves) == seen:
            if time.monotonic() > end:
                return False
            self.hand.look(_LOOK)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self.hand.status.get("hold_owner") != OWNER:
                return False
            self.hand.look(_LOOK)
        return True

    def let_go(self) -> None:
        """Let go, and wait for nothing."""
        if self.by == "pointer":
            self.tab.release_pointer(*BUTTON)
        elif self.by == "touch":
            self.tab.touch()
        else:
            self.tab.release_space()

    def release(self) -> None:
        """Let go, and wait until that is known."""
        self.let_go()
        self.hand.until(lambda: self.hand.status.get("hold_owner", "") == "", "the hold is off")

    def close(self) -> None:
        """End all."""
        self._open.close()

    def _browser(self) -> Chromium:
        self._profiles += 1
        browser = Chromium(self._folder / f"profile_{self._profiles}")
        self._open.callback(browser.close)
        return browser


class _Console:
    """The stand-in's process.

    Parameters
    ----------
    folder : Path
        Takes its log.
    domain : int
        ROS_DOMAIN_ID.
    """

    def __init__(self, folder: Path, domain: int) -> None:
        with (folder / "console_stand_in.log").open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "campaign.trials.console.console_stand_in"],
                env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,
            )
        assert self._process.stdout is not None
        said = self._process.stdout.readline()
        if not said:
            raise UserError("the console's stand-in does not start")
        self.ports: dict[str, int] = json.loads(said)

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self._process.send_signal(number)

    def close(self) -> None:
        """End it in order."""
        self.signal(signal.SIGCONT)
        self._process.communicate()


def _rig() -> Parameters:
    values = {"level": "tip", "max_depth": 0.5}
    return {"sim_rig": values}
