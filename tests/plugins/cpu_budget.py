"""A pytest plugin: how much CPU each test uses, and that none of a layer uses more than it may.

A test that uses `ENDLESS` is taken for one that never ends, and fails; a check of the campaign may
take hours.
Processes that a test started and that ended count, too; what is shared by a module or the session
counts to nobody. CPU-seconds are those of a machine on which `_reference` takes `NOMINAL`: on a
slower one, or one whose cores share their units with other work, a test may use more.
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
"""CPU time of `_reference` on the machine whose seconds the limits are [s]."""


@dataclasses.dataclass(frozen=True)
class Layer:
    """Tests of one kind.

    Attributes
    ----------
    name : str
        Of the layer.
    files : re.Pattern
        Its test files.
    each : float
        What one of its tests may use [CPU-s].
    """

    name: str
    files: re.Pattern[str]
    each: float


LAYERS = (
    Layer(
        "sequences and studies",
        re.compile(
            r"ros2_ws/src/"
            r"(needle_tracker/test/(filter|calibrating)|.*/test/studies|.*/test_vision)"
        ),
        2.0,
    ),
    Layer("unit and component", re.compile(r"ros2_ws/src/"), 0.3),
    Layer("scenario", re.compile(r"tests/scenario/"), 20.0),
    Layer("smoke", re.compile(r"tests/smoke/"), 60.0),
    Layer("static", re.compile(r"tests/static/"), 120.0),
    Layer("oracles and site", re.compile(r"tests/"), 20.0),
)
"""The first whose pattern matches is a test's."""
TOLERANCE = 1.5
"""By so much CPU-seconds vary on a machine whose cores share their caches with other work."""
ENDLESS = 300.0
"""CPU-seconds at which a test is ended."""
_CPU, _OVER = "cpu_s", "over_budget"


class CpuBudget:
    """Measures tests where they run, and adds up where their reports arrive.

    Attributes
    ----------
    is_enforced : bool
        Whether a test over its budget fails the run: where only a few run, each may be the first
        that has to load a library.
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
        """Note what fixtures use that several tests share."""
        begin, inner = _cpu(), self._shared
        try:
            return (yield)
        finally:
            if fixturedef.scope != "function":
                self._shared = inner + _cpu() - begin

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logstart(self) -> None:
        """Begin to measure a test."""
        self._shared, self._begin = 0.0, _cpu()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, object, object]:
        """End a test that never ends by itself."""
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
        """Write into a test's last report what all of it used."""
        report = yield
        if call.when == "teardown":
            whole = _cpu() - self._begin
            own, limit = whole - self._shared, _layer(item.nodeid).each
            report.user_properties.append((_CPU, whole))
            if self.is_enforced and own > limit and own > TOLERANCE * limit * _slowness():
                report.user_properties.append((_OVER, own))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add a test up."""
        told: dict[str, Any] = dict(report.user_properties)
        if report.when != "teardown" or _CPU not in told:
            return
        layer = _layer(report.nodeid)
        self._used[layer.name] += told[_CPU]
        self._tests[layer.name] += 1
        if _OVER in told:
            self._over.append(
                f"{report.nodeid}: {told[_OVER]:.2f} CPU-s, of {layer.each:g} at most"
            )

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fail the session if a test used more than it may."""
        if self._over and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print the sum of each layer, and who used too much."""
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
    """Return the CPU time of this process and of those it has waited for [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _slowness() -> float:
    """Return how many times slower than the nominal machine this one is at the moment."""
    begin = time.process_time()
    _reference()
    return max(1.0, (time.process_time() - begin) / NOMINAL)


def _reference() -> float:
    total = 0.0
    for number in range(500_000):
        total += number * 0.5
    return total
