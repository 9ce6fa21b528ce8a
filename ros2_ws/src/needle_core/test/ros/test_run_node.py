"""Start and end of a node: exit codes, last messages, and one-line errors."""

from __future__ import annotations

import dataclasses
import signal
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.impl.implementation_singleton import rclpy_implementation

from needle_core.errors import UserError
from needle_core.ros import main
from needle_core.ros.main import run_node


@dataclasses.dataclass(frozen=True)
class NoParameters:
    """Empty parameters of a node."""


class Middleware:
    """Stand-in for rclpy and its one node, which has one publisher."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done: list[str] = []
        for name in ("restrict_discovery", "remove_incomplete_ports"):
            monkeypatch.setattr(main, name, lambda **_: None)
        monkeypatch.setattr(main, "rclpy", self)

    def init(self, **_: Any) -> None:
        self.done.append("init")

    def try_shutdown(self) -> None:
        self.done.append("shutdown")

    def make(self) -> Any:
        def wait(duration: Any) -> None:
            self.done.append(f"acknowledged within {duration.nanoseconds * 1e-9:.1f} s")

        return SimpleNamespace(
            context=SimpleNamespace(ok=lambda: True),
            publishers=[SimpleNamespace(wait_for_all_acked=wait)],
            destroy_node=lambda: self.done.append("destroyed"),
        )


@pytest.fixture
def middleware(monkeypatch: pytest.MonkeyPatch) -> Middleware:
    return Middleware(monkeypatch)


def run(create: Any, *argv: str, spin: Any = None) -> int:
    return run_node(
        create, help_text="HELP", parameters=NoParameters, args=["node", *argv], spin=spin
    )


def fail(error: Exception, *, signalled: bool = False) -> Any:
    def act(*_: Any) -> Any:
        if signalled:
            signal.raise_signal(signal.SIGTERM)
        raise error

    return act


def test_a_node_ends_when_its_messages_are_acknowledged(middleware: Middleware) -> None:
    def end_by_signal(_: Any, end: Any) -> int:
        signal.raise_signal(signal.SIGINT)
        return int(end.requested)

    for spin, code, seconds in ((lambda node, end: 7, 7, 5.0), (end_by_signal, 1, 0.5)):
        middleware.done.clear()
        assert run(middleware.make, spin=spin) == code
        acknowledged = f"acknowledged within {seconds} s"
        assert middleware.done == ["init", acknowledged, "destroyed", "shutdown"]


def test_a_failure_is_bad_input_an_internal_error_or_ignored_after_a_signal(
    middleware: Middleware, capsys: pytest.CaptureFixture[str]
) -> None:
    bad, odd = UserError("rate = 0 Hz, must be > 0"), RuntimeError("a fault of its own")
    lost = rclpy_implementation.RCLError("bad name")
    for create, spin, code, error in (
        (fail(bad), None, 2, "error: rate = 0 Hz, must be > 0\n"),
        (fail(bad, signalled=True), None, 0, "error: rate = 0 Hz, must be > 0\n"),
        (fail(lost), None, 2, "error: bad name\n"),
        (fail(odd), None, 3, "error: internal error, "),
        (middleware.make, fail(odd), 3, "error: internal error, "),
        (middleware.make, fail(lost), 3, "error: internal error, "),
        (middleware.make, fail(bad), 2, "error: rate = 0 Hz, must be > 0\n"),
    ):
        middleware.done.clear()
        assert run(create, spin=spin) == code
        assert capsys.readouterr().err.startswith(error)
        assert middleware.done[-1] == "shutdown"
        assert ("destroyed" in middleware.done) is (spin is not None)


def test_arguments_are_explained_or_rejected_before_the_start(
    middleware: Middleware, capsys: pytest.CaptureFixture[str]
) -> None:
    for word in ("--help", "-h"):
        assert run(None, word) == 0
        assert capsys.readouterr().out.startswith("HELP\n")
    for argv, cause in (
        (("--fast",), "'--fast'; see --help"),
        (("-p", "x:=1"), "'-p'; put it after --ros-args"),
        (("rate:=1", "--ros-args", "-p", "other:=1"), "set a parameter with --ros-args -p rate:=1"),
        (("--ros-args", "--params-file", "none.yaml"), "none.yaml: cannot be read"),
    ):
        assert run(None, *argv) == 2
        assert cause in capsys.readouterr().err
    assert middleware.done == []
