"""A pytest plugin of scripts/test: lanes, and the processes that tests left.

scripts/test sets NEEDLE_TEST_RUN, unique to the run and inherited by every process that a test
starts. pytest-xdist runs the test files in lanes, each a process of its own; nodes of one lane must
not hear those of another.

Three lanes share two cores. Files that only reckon (`IN_BACKGROUND`) take what the others leave:
those with nodes and watchdogs wait most of their time, and are late when nobody makes way for them.
At most two of these run at a time.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import os
import re
import signal
import time
from collections.abc import Generator
from pathlib import Path

import pytest

from needle_common.process.ros_domain import own_domain

RUN = os.environ.get("NEEDLE_TEST_RUN", "")
# These take half a minute and more: begun last, one of them would hold up the end of the run.
LONG_FILES = (
    "tests/test_documents.py",
    "tests/test_lint.py",
    "tests/site/test_docs_site.py",
    "ros2_ws/src/needle_bringup/test/graph/test_graph_run.py",
    "ros2_ws/src/needle_verification/test/checks/test_check_driver.py",
    "ros2_ws/src/needle_bringup/test/graph/test_console.py",
    "ros2_ws/src/needle_bringup/test/graph/test_graph_interrupt.py",
    "ros2_ws/src/needle_tracker/test/calibrating/test_calibration_commands.py",
    "ros2_ws/src/needle_analysis/test/ros/test_rerun.py",
    "ros2_ws/src/needle_analysis/test/ros/test_rerun_hearing.py",
    "ros2_ws/src/needle_verification/test/checks/test_check_bags.py",
    "ros2_ws/src/needle_verification/test/checks/test_check_console_hold.py",
)
IN_BACKGROUND = re.compile(
    r"tests/(test_lint|site/test_docs_site)\.py|.*/needle_(tracker|controller)/test/(?!ros/).*|"
    r".*/needle_sim/test/(camera|needle|path_traced|studies)/.*|"
    r".*/needle_analysis/test/(report|run|rerun)/.*|"
    r".*/needle_verification/test/(studies|tracking|training|paper)/.*"
)
"""Test files without processes or watchdogs of their own."""
BACKGROUND_LIMIT = 900.0
"""A test's time in the background [s]: while both cores are in use it may stand still."""
_IN_FRONT = 2
_left: list[str] = []
_place = contextlib.ExitStack()
_running: list[str] = []
"""The file that has this lane's place; empty between two."""
_reserved = contextlib.ExitStack()


def pytest_configure(config: pytest.Config) -> None:
    """Reserve a ROS domain for each lane, and end as Ctrl-C does: with all cleaning up."""
    if in_lane(config):
        os.environ["ROS_DOMAIN_ID"] = str(_reserved.enter_context(own_domain()))
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)


def pytest_unconfigure() -> None:
    """Give the lane's ROS domain back."""
    _reserved.close()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without searches for garbage: what comes up is there to stay."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, all else as it was collected; give time to who makes way."""
    for item in items:
        if IN_BACKGROUND.fullmatch(_file_of(item)):
            item.add_marker(pytest.mark.timeout(BACKGROUND_LIMIT), append=False)
    places = {file: place for place, file in enumerate(LONG_FILES)}
    items.sort(key=lambda item: places.get(_file_of(item), len(places)))


# First of all: a test's own time limit begins when it has its place.
@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(
    item: pytest.Item, nextitem: pytest.Item | None
) -> Generator[None, object, object]:
    """Take a file's place, in front or in the background, for as long as it runs."""
    file = _file_of(item)
    if in_lane(item.config) and _running != [file]:
        _take_place(file)
        _running[:] = [file]
    result = yield
    if nextitem is None or _file_of(nextitem) != file:
        _running.clear()
        _place.close()
    return result


def _file_of(item: pytest.Item) -> str:
    return item.nodeid.partition("::")[0]


def _take_place(file: str) -> None:
    policy = os.SCHED_IDLE if IN_BACKGROUND.fullmatch(file) else os.SCHED_OTHER
    os.sched_setscheduler(0, policy, os.sched_param(0))
    if policy == os.SCHED_IDLE:
        return
    names = [Path(os.environ["TMPDIR"], f"place_{n}") for n in range(_IN_FRONT)]
    places = [_place.enter_context(name.open("wb")) for name in names]
    while True:
        for place in places:
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
        time.sleep(0.05)


def in_lane(config: pytest.Config) -> bool:
    """Return whether this process runs tests for another one that collects the results."""
    return hasattr(config, "workerinput")


def processes_of_run() -> dict[int, str]:
    """Return the command lines, by process id, of what this run started and did not end."""
    found = {}
    mark = f"NEEDLE_TEST_RUN={RUN}".encode()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if int(folder.name) == os.getpid() or mark not in (
                (folder / "environ").read_bytes().split(b"\0")
            ):
                continue
            command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
        except OSError:
            continue
        if command:
            found[int(folder.name)] = command
    return found


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail the session, and end them, when processes are left."""
    # One lane may end while the other's processes are at work.
    if not RUN or in_lane(session.config):
        return
    limit = time.monotonic() + 2.0
    # What was just told to end may need a moment.
    while (left := processes_of_run()) and time.monotonic() < limit:
        time.sleep(0.05)
    for process, command in left.items():
        _left.append(f"{process} {command}")
        try:
            os.kill(process, signal.SIGKILL)
        except ProcessLookupError:
            continue
    if left and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what was left, right above pytest's closing line."""
    for line in _left:
        terminalreporter.write_line(f"FAILED process left behind: {line}", red=True)
