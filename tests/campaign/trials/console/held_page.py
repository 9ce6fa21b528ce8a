"""A page's button that is held in a real browser, and what is lost between finger and console."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from campaign.trials.console.button_page import BUTTON, serving_button
from campaign.trials.console.chromium import Chromium, Tab
from campaign.trials.console.stalling_proxy import StallingProxy
from needle_console.hold.hold_state import HoldState
from needle_core.errors import UserError

# How long the hold has counted before a loss, and how long it is watched afterwards [s].
_HELD, _WATCHED = (0.1, 0.9), 1.0
_TRIES, _PATIENCE, _LOOK = 50, 30.0, 0.005
_STATE = "document.documentElement.dataset.holdState"


def page_trials(folder: Path, loss: str, count: int, seed: int = 1) -> list[dict[str, Any]]:
    """Return what came of each loss of a kind.

    Parameters
    ----------
    folder : Path
        Takes the browser's profiles.
    loss : str
        One of `LOSSES`.
    count : int
        Losses.
    seed : int
        Of all that is drawn.
    """
    said: list[tuple[int, bool]] = []

    def hear(state: HoldState) -> None:
        said.append((time.time_ns(), state.pressed))

    with (
        serving_button(hear, lambda _: None) as (page_port, hold),
        closing(StallingProxy(hold.port)) as proxy,
        closing(HeldPage(folder, page_port, proxy, random.Random(f"{seed} {loss}"))) as page,
    ):
        return [page.lose(loss, said) for _ in range(count)]


class HeldPage:
    """A person at a page.

    Parameters
    ----------
    folder : Path
        Takes the browser's profiles.
    page_port : int
        Of the page.
    proxy : StallingProxy
        Its way to the hold's server.
    rng : Random
        Of moments and ways to press.
    """

    def __init__(
        self, folder: Path, page_port: int, proxy: StallingProxy, rng: random.Random
    ) -> None:
        self._folder, self._rng, self._proxy = folder, rng, proxy
        self._url = f"http://127.0.0.1:{page_port}/?port={proxy.port}"
        self._browsers = 0
        self._by = "pointer"
        self._open_browser()

    def lose(self, loss: str, said: list[tuple[int, bool]]) -> dict[str, Any]:
        """Hold for a while, lose something, and see how long a hold was told by the server."""
        self._hold(said, self._rng.uniform(*_HELD))
        lost_ns, held = time.time_ns(), said[-1][1]
        lost_ns = LOSSES[loss](self) or lost_ns
        times = [(at - lost_ns) * 1e-6 for at, pressed in said if pressed]
        return {"pressed_by": self._by, "held": held, "last_ms": max(times)}

    def close(self) -> None:
        """End the browser."""
        self._browser.close()

    def _open_browser(self) -> None:
        self._browsers += 1
        self._browser = Chromium(self._folder / f"profile_{self._browsers}")
        self._open_page()

    def _open_page(self) -> None:
        self._tab: Tab = self._browser.open(self._url)

    def _hold(self, said: list[tuple[int, bool]], seconds: float) -> None:
        """Press anew, until a hold counts for so long [s]: a busy machine loses some."""
        for _ in range(_TRIES):
            self._let_go()
            _until(lambda: self._tab.run(_STATE) in ("ready", "again"), "the page is connected")
            self._by = self._rng.choice(("pointer", "touch", "space"))
            if self._by == "pointer":
                self._tab.press_pointer(*BUTTON)
            elif self._by == "touch":
                self._tab.touch(BUTTON)
            else:
                self._tab.press_space()
            seen = len(said)
            _until(lambda seen=seen: len(said) > seen + 5, "states are told")  # type: ignore[misc]
            time.sleep(seconds)
            if said[-1][1]:
                return
        raise UserError(f"no hold lasted for {seconds:.1f} s in {_TRIES} presses")

    def _let_go(self) -> None:
        if self._by == "pointer":
            self._tab.release_pointer(*BUTTON)
        elif self._by == "touch":
            self._tab.touch()
        else:
            self._tab.release_space()

    # ---- losses: each is watched, and put right -------------------------------------------------

    def _close(self) -> None:
        self._tab.close()
        time.sleep(_WATCHED)
        self._open_page()

    def _hide(self) -> int:
        self._tab.run("window.lostAt = null")
        self._browser.post("Target.createTarget", url="about:blank")
        time.sleep(_WATCHED)
        lost_at_ns = self._lost_at_ns()
        self._browser.close_all_but(self._tab)
        time.sleep(_WATCHED)
        return lost_at_ns

    def _take_focus(self) -> int:
        self._tab.run("window.lostAt = null")
        self._tab.post("window.frames[0].focus()")
        time.sleep(_WATCHED)
        lost_at_ns = self._lost_at_ns()
        self._tab.run("window.focus()")
        return lost_at_ns

    def _lost_at_ns(self) -> int:
        """Return when the page lost sight or focus: a browser that is told so takes its time."""
        return int(float(self._tab.run("window.lostAt")) * 1e6)

    def _stop(self) -> None:
        self._browser.signal(signal.SIGSTOP)
        time.sleep(self._rng.uniform(0.2, 2.0))
        self._browser.signal(signal.SIGCONT)
        time.sleep(_WATCHED)

    def _kill(self) -> None:
        self._browser.kill()
        time.sleep(_WATCHED)
        self._browser.close()
        self._open_browser()

    def _stall(self) -> None:
        self._proxy.stall()
        time.sleep(self._rng.uniform(0.1, 5.0))
        self._proxy.flow()
        time.sleep(_WATCHED)


LOSSES: Mapping[str, Callable[[HeldPage], int | None]] = {
    "closed": HeldPage._close,
    "hidden": HeldPage._hide,
    "unfocused": HeldPage._take_focus,
    "stopped": HeldPage._stop,
    "killed": HeldPage._kill,
    "stalled": HeldPage._stall,
}
"""Each returns when it happened [ns], if later than it was asked for."""


def _until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + _PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            raise UserError(f"waited {_PATIENCE:g} s in vain: {what}")
        time.sleep(_LOOK)
