"""The console's rig in one process, without a served page."""

from __future__ import annotations

import os
import signal
import sys
import types
from collections.abc import Callable
from unittest import mock

import pytest

from needle_bringup.simulation import console
from needle_console.console import PAGE
from needle_console.console_parameters import ConsoleParameters
from needle_core.component import Component, Exit
from needle_core.errors import UserError
from needle_core.runners import paced

Ends = Callable[["PlayedRunner"], bool]


class PlayedPage:
    """Stand-in for the page, which needs an extra to be served."""

    def __init__(self, settings: ConsoleParameters) -> None:
        if settings.hold_port == 9999:
            raise UserError("127.0.0.1:9999: Address already in use")
        self.settings = settings
        self.lag = 0.0

    def set_lag(self, lag: float) -> None:
        self.lag = lag


class PlayedRunner:
    """Runner that does nothing until the test ends it."""

    ends: Ends
    last: PlayedRunner

    def __init__(
        self, components: list[Component], seed: int, *, ports: dict[str, PlayedPage]
    ) -> None:
        PlayedRunner.last = self
        self.names = [component.name for component in components]
        self.page = ports[PAGE]
        self.exits: dict[str, Exit] = {}
        self.lag, self.closed = 0.25, False

    def run(self, seconds: float) -> bool:
        return PlayedRunner.ends(self)

    def close(self) -> None:
        self.closed = True


def run(monkeypatch: pytest.MonkeyPatch, ends: Ends, port: int = 9000) -> int:
    monkeypatch.setattr(paced, "PacedRunner", PlayedRunner)
    monkeypatch.setattr(PlayedRunner, "ends", staticmethod(ends), raising=False)
    server = types.ModuleType("needle_console.page.web_server")
    server.ServedPagePort = PlayedPage  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, server.__name__, server)
    with mock.patch.dict(os.environ):
        return console.main(["--level", "tip", "--port", str(port)])


def test_rig_and_page_run_until_a_signal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ends(runner: PlayedRunner) -> bool:
        if runner.page.lag:
            signal.raise_signal(signal.SIGINT)
        return False

    assert run(monkeypatch, ends) == 130
    runner = PlayedRunner.last
    assert runner.names == ["sim_rig", "plane_controller", "console"]
    assert (runner.page.settings.port, runner.page.settings.hold_port) == (9000, 9001)
    assert runner.page.lag == runner.lag
    assert runner.closed
    assert capsys.readouterr().out.startswith("http://127.0.0.1:9000/ ")


def test_an_ended_component_and_a_port_in_use_give_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ends(runner: PlayedRunner) -> bool:
        runner.exits["sim_rig"] = Exit(1, "out of luck")
        return True

    assert run(monkeypatch, ends) == 1
    assert PlayedRunner.last.closed
    assert capsys.readouterr().err == "error: sim_rig ended: out of luck\n"
    assert run(monkeypatch, ends, port=9998) == 2
    assert capsys.readouterr().err == "error: 127.0.0.1:9999: Address already in use\n"
