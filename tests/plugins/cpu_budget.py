"""A pytest plugin that measures the CPU time of each test, and enforces the budget of its layer.

A test that uses `ENDLESS` fails, except in the campaign. Ended child processes count; fixtures of a
module or the session do not. CPU-seconds are those of a machine on which `_reference` takes
`NOMINAL`: on a slower or loaded machine, a test may use more.
"""

from __future__ import annotations

import dataclasses
import re
import resource
import signal
import time
from collections import Counter
from collections.abc import Generator
from typing import Any

import pytest

NOMINAL = 0.020
"""CPU time of `_reference` on the machine of the limits [s]."""


@dataclasses.dataclass(frozen=True)
class Layer:
    """Tests of one kind.

    Attributes
    ----------
    name : str
        Name of the layer.
    files : re.Pattern
        Pattern of its test files.
    each : float
        Budget of one test [CPU-s].
    """

    name: str
    files: re.Pattern[str]
    each: float


LAYERS = (
    Layer(
        "sequences and studies",
        re.compile(
            r"ros2_ws/src/"
            r"(needle_tracker/test/(filter|calibrating)|.*/test/studies|.*/test_remote_tracker)"
        ),
        2.0,
    ),
    Layer("scenario", re.compile(r"tests/scenario/|ros2_ws/src/.*/conformance/"), 20.0),
    Layer("unit and component", re.compile(r"ros2_ws/src/"), 0.3),
    Layer("smoke", re.compile(r"tests/smoke/"), 60.0),
    Layer("static", re.compile(r"tests/static/"), 120.0),
    Layer("oracles and site", re.compile(r"tests/"), 20.0),
)
"""Layers; a test belongs to the first with a matching pattern."""
TOLERANCE = 2.0
"""Factor by which CPU-seconds vary: the second thread of a core may become busy meanwhile."""
ENDLESS = 300.0
"""CPU-seconds at which a test is stopped."""
_CPU, _OVER = "cpu_s", "over_budget"


class CpuBudget:
    """Measures tests in the shards, and adds up their reports in the main process.

    Attributes
    ----------
    is_enforced : bool
        Whether a test over its budget fails the run; not in a run of few tests, where each may be
        the first to load a library.
    """

    def __init__(self) -> None:
        self.is_enforced = False
        self._shared = 0.0
        self._begin = 0.0
        self._used: Counter[str] = Counter()
        self._tests: Counter[str] = Counter()
        self._over: list[str] = []

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Generator[None, object, object]:
        """Measure the fixtures that several tests share."""
        begin, inner = _cpu(), self._shared
        try:
            return (yield)
        finally:
            if fixturedef.scope != "function":
                self._shared = inner + _cpu() - begin

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logstart(self) -> None:
        """Start to measure a test."""
        self._shared, self._begin = 0.0, _cpu()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, object, object]:
        """Stop a test that does not end."""
        signal.signal(signal.SIGPROF, _fail_endless)
        is_unlimited = item.get_closest_marker("campaign") is not None
        signal.setitimer(signal.ITIMER_PROF, 0.0 if is_unlimited else ENDLESS)
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Write the CPU time into the last report of a test."""
        report = yield
        if call.when == "teardown":
            whole = _cpu() - self._begin
            own, limit = whole - self._shared, _layer(item.nodeid).each
            report.user_properties.append((_CPU, whole))
            if self.is_enforced and own > limit and own > TOLERANCE * limit * _slowness():
                report.user_properties.append((_OVER, own))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add the CPU time of a test."""
        properties: dict[str, Any] = dict(report.user_properties)
        if report.when != "teardown" or _CPU not in properties:
            return
        layer = _layer(report.nodeid)
        self._used[layer.name] += properties[_CPU]
        self._tests[layer.name] += 1
        if _OVER in properties:
            self._over.append(
                f"{report.nodeid}: {properties[_OVER]:.2f} CPU-s, of {layer.each:g} at most"
            )

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fail the session if a test exceeded its budget."""
        if self._over and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print the sum of each layer, and the tests over budget."""
        sums = (
            f"{layer.name} {self._used[layer.name]:.0f} ({self._tests[layer.name]} tests)"
            for layer in LAYERS
            if self._tests[layer.name]
        )
        terminalreporter.write_line(f"CPU-s          {', '.join(sums)}")
        for line in self._over:
            terminalreporter.write_line(f"FAILED over its budget: {line}", red=True)


def _fail_endless(*_: object) -> None:
    pytest.fail(f"it does not end: {ENDLESS:g} CPU-s")


def _layer(nodeid: str) -> Layer:
    return next((layer for layer in LAYERS if layer.files.match(nodeid)), LAYERS[-1])


def _cpu() -> float:
    """Return the CPU time of this process and its ended children [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _slowness() -> float:
    """Return the present slowness relative to the nominal machine."""
    begin = time.process_time()
    _reference()
    return max(1.0, (time.process_time() - begin) / NOMINAL)


def _reference() -> float:
    total = 0.0
    for number in range(500_000):
        total += number * 0.5
    return total
