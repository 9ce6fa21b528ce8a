"""Losses between a finger and the needle."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping

from campaign.trials.console.console_scene import Scene

# How long is looked whether the needle moves again [s].
_WATCHED = 1.0


def let_go(scene: Scene) -> None:
    """Let go, as a person does."""
    scene.let_go()
    scene.hand.pause(_WATCHED)


def _closed(scene: Scene) -> None:
    scene.tab.close()
    scene.hand.pause(_WATCHED)
    scene.tab = scene.page()


def _hidden(scene: Scene) -> int:
    scene.tab.run("window.lostAt = null")
    scene.browser.post("Target.createTarget", url="about:blank")
    scene.hand.pause(_WATCHED)
    lost_at_ns = _lost_at_ns(scene)
    scene.browser.close_all_but(scene.tab)
    scene.hand.pause(_WATCHED)
    return lost_at_ns


def _unfocused(scene: Scene) -> int:
    scene.tab.run("window.lostAt = null")
    scene.tab.post("window.frames[0].focus()")
    scene.hand.pause(_WATCHED)
    lost_at_ns = _lost_at_ns(scene)
    scene.tab.run("window.focus()")
    return lost_at_ns


def _lost_at_ns(scene: Scene) -> int:
    """Return when the page lost sight or focus: a browser that is told so takes its time."""
    return int(float(scene.tab.run("window.lostAt")) * 1e6)


def _stopped(scene: Scene) -> None:
    scene.browser.signal(signal.SIGSTOP)
    scene.hand.pause(scene.rng.uniform(0.2, 2.0))
    scene.browser.signal(signal.SIGCONT)
    scene.hand.pause(_WATCHED)


def _killed(scene: Scene) -> None:
    scene.browser.kill()
    scene.hand.pause(_WATCHED)
    scene.restart_browser()


def _stalled(scene: Scene) -> None:
    scene.proxy.stall()
    scene.hand.pause(scene.rng.uniform(0.1, 5.0))
    scene.proxy.flow()
    scene.hand.pause(_WATCHED)


def _asleep(scene: Scene) -> None:
    scene.console.signal(signal.SIGSTOP)
    scene.hand.pause(scene.rng.uniform(0.2, 2.0))
    scene.console.signal(signal.SIGCONT)
    scene.hand.pause(_WATCHED)


Loss = Callable[[Scene], int | None]
"""Loses something, looks what comes of it, and puts it right; returns when it was lost [ns]."""

LOSSES: Mapping[str, Loss] = {
    "closed": _closed,
    "hidden": _hidden,
    "unfocused": _unfocused,
    "stopped": _stopped,
    "killed": _killed,
    "stalled": _stalled,
    "asleep": _asleep,
}
