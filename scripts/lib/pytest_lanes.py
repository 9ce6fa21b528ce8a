"""A pytest plugin of scripts/test: lanes, and the processes that tests left.

scripts/test sets NEEDLE_TEST_RUN, unique to the run and inherited by every process that a test
starts. pytest-xdist runs the test files in lanes, each a process of its own; nodes of one lane must
not hear those of another.

Four lanes share two cores. Files with nodes and watchdogs of their own wait a third of their time,
and are late when nobody makes way for them: at most two of them run at a time. Files that only
reckon (`IN_BACKGROUND`) take what those leave.
"""

from __future__ import annotations

import contextlib
import gc
import os
import re
import signal
import time
from collections.abc import Collection, Generator
from pathlib import Path

import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadFileScheduling
from xdist.workermanage import WorkerController

from needle_core.process.ros_domain import own_domain

RUN = os.environ.get("NEEDLE_TEST_RUN", "")
# These take half a minute and more: begun last, one of them would hold up the end of the run.
LONG_FILES = (
    "tests/test_documents.py",
    "tests/test_lint.py",
    "tests/site/test_docs_site.py",
    "ros2_ws/src/needle_bringup/test/graph/test_graph_run.py",
    "ros2_ws/src/needle_bringup/test/graph/test_graph_interrupt.py",
    "ros2_ws/src/needle_tracker/test/calibrating/test_calibration_commands.py",
)
IN_BACKGROUND = re.compile(
    r"tests/(test_(lint|reference)|(oracles|site)/\w+)\.py|"
    r".*/needle_(tracker|controller)/test/(?!ros/).*|"
    r".*/needle_sim/test/(camera|needle|path_traced|studies)/.*|"
    r".*/needle_bags/test/(reading|recovery)/.*|"
    r".*/needle_analysis/test/(report/|run/|rerun/|ros/test_(rerun|hostile)).*|"
)
"""Test files without processes or watchdogs of their own."""
BACKGROUND_LIMIT = 900.0
"""A test's time in the background [s]: while both cores are in use it may stand still."""
_IN_FRONT = 2
"""How many files may run in front of the others at a time."""
_BACKGROUND_NICENESS = 10
_left: list[str] = []
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


class LaneScheduling(LoadFileScheduling):
    """Hands out the files, in their order, each to a lane that may run it at once."""

    def _assign_work_unit(self, node: WorkerController) -> None:
        lanes_in_front = sum(
            any(_runs_in_front(file) and not all(done.values()) for file, done in files.items())
            for lane, files in self.assigned_work.items()
            if lane is not node
        )
        # Only a privileged user may take back what a lane gave away.
        stays_behind = not all(map(_runs_in_front, self.assigned_work[node]))
        file = next_file(self.workqueue, in_front=lanes_in_front < _IN_FRONT and not stays_behind)
        if file is None:
            # What is left is for the lanes in front.
            node.shutdown()
        else:
            self.workqueue.move_to_end(file, last=False)
            super()._assign_work_unit(node)


def next_file(waiting: Collection[str], *, in_front: bool) -> str | None:
    """Return the test file that a lane gets next, or None.

    Parameters
    ----------
    waiting : collection of str
        Test files that no lane has yet.
    in_front : bool
        Whether the lane may run in front; it is in the background when nothing is left there.
    """
    kinds = (True, False) if in_front else (False,)
    return next((file for kind in kinds for file in waiting if _runs_in_front(file) is kind), None)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LaneScheduling:
    """Return what hands out the files in place of xdist's own."""
    return LaneScheduling(config, log)


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
        if not _runs_in_front(_file_of(item)):
            item.add_marker(pytest.mark.timeout(BACKGROUND_LIMIT), append=False)
    places = {file: place for place, file in enumerate(LONG_FILES)}
    items.sort(key=lambda item: places.get(_file_of(item), len(places)))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> None:
    """Make way for the files in front."""
    if in_lane(item.config) and not _runs_in_front(_file_of(item)):
        os.setpriority(os.PRIO_PROCESS, 0, _BACKGROUND_NICENESS)


def _file_of(item: pytest.Item) -> str:
    return item.nodeid.partition("::")[0]


def _runs_in_front(file: str) -> bool:
    return IN_BACKGROUND.fullmatch(file) is None


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
