"""A pytest plugin of scripts/test: collects once, runs on all cores, enforces CPU budgets.

The process that collected forks one shard per core. The shards take test files from one pipe, the
longest ones first, and send their reports back. Smoke tests and the campaign start real nodes: they
run at the end, one after the other, with no other load.
"""

from __future__ import annotations

import contextlib
import gc
import io
import multiprocessing
import os
import re
import signal
import time
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

import pytest

import compile_ahead
from child_processes import processes_with
from cpu_budget import CpuBudget
from needle_bringup.studies import monte_carlo
from needle_core.process.ros_domain import reserve_domain_id

SHARDS = os.cpu_count() or 1
# Start the longest files first, to balance the shards.
LONG = re.compile(r"tests/(static|scenario)/|.*/test/(tracking|studies|curvature)/")
ALONE = ("tests/smoke/", "tests/campaign/")
WHOLE = 1000
"""Number of tests above which a run counts as complete."""
_INDEX_BYTES = 4
# Environment variable by which processes of this run are found.
_RUN_MARK = "NEEDLE_TEST_RUN"
_EXIT_GRACE = 2.0  # time that a signalled process has to exit [s]
_reserved = contextlib.ExitStack()
_budget = CpuBudget()


def pytest_configure(config: pytest.Config) -> None:
    """Reserve a ROS domain, and clean up on signals as on Ctrl-C."""
    os.environ["ROS_DOMAIN_ID"] = str(_reserved.enter_context(reserve_domain_id()))
    # A shell ignores SIGINT in background jobs, and children inherit that.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    config.pluginmanager.register(_budget)


def pytest_unconfigure() -> None:
    """Release the ROS domain."""
    _reserved.close()


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> object:
    """Run the collected tests: in shards, then those that must be alone."""
    if session.config.option.collectonly or session.testsfailed:
        return None
    if len(session.items) > WHOLE:
        _warm_up()
        _budget.is_enforced = True
    # The first access empties the folder, so it must not happen in a shard.
    session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]
    files = _by_file(session.items)
    alone = [item for file in files if file.startswith(ALONE) for item in files[file]]
    others = sorted(
        (items for file, items in files.items() if not file.startswith(ALONE)),
        key=lambda items: LONG.match(items[0].nodeid) is None,
    )
    _run_in_shards(session, others)
    _run_all(session, iter(alone))
    return True


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Kill leftover processes, and fail the session if there are any."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    for line in _kill_leftover_processes():
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED
        if reporter is not None:
            reporter.write_line(f"FAILED process left behind: {line}", red=True)


def _kill_leftover_processes() -> list[str]:
    """Kill processes that tests started and left; return a line for each."""
    run = os.environ.get(_RUN_MARK, "")
    if not run:
        return []
    end = time.monotonic() + _EXIT_GRACE
    while True:
        # A zombie has no command.
        found = [one for one in processes_with(_RUN_MARK, run) if one[0] != os.getpid() and one[1]]
        if not found or time.monotonic() > end:
            break
        time.sleep(0.05)
    for process, _ in found:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    return [f"{process} {command}" for process, command in found]


def _warm_up() -> None:
    """Load or compile numerical code once for all shards, outside of any test's budget."""
    for part in compile_ahead.PARTS.values():
        part()
    troubled = ["--targets", "2", "--depth-mm", "2", "--play-deg", "10", "--lag-mm", "5"]
    with contextlib.redirect_stdout(io.StringIO()):
        for law in ("best", "rrt"):
            monte_carlo.main(["--controller", law, *troubled])


class _Sender:
    """Sends the reports of a shard to the main process."""

    def __init__(self, config: pytest.Config, to: Connection) -> None:
        self._config, self._to = config, to

    def pytest_runtest_logstart(self, nodeid: str, location: object) -> None:
        """Send the name of the test, reported if this process dies."""
        self._to.send(nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Send a report."""
        hook = self._config.hook
        self._to.send(hook.pytest_report_to_serializable(config=self._config, report=report))


def _by_file(items: Sequence[pytest.Item]) -> dict[str, list[pytest.Item]]:
    files: dict[str, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.nodeid.partition("::")[0], []).append(item)
    return files


def _run_in_shards(session: pytest.Session, files: Sequence[Sequence[pytest.Item]]) -> None:
    if not files:
        return
    waiting, given_out = os.pipe()
    gc.freeze()
    shards: dict[Connection, int] = {}
    for _ in range(min(SHARDS, len(files))):
        ours, theirs = multiprocessing.Pipe(duplex=False)
        process = os.fork()
        if process == 0:
            os.close(given_out)
            _be_a_shard(session, theirs, _taken(waiting, files))
        theirs.close()
        shards[ours] = process
    os.close(waiting)
    os.write(given_out, b"".join(n.to_bytes(_INDEX_BYTES, "big") for n in range(len(files))))
    os.close(given_out)
    try:
        _pass_on_reports(session, shards)
    finally:
        for process in shards.values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGTERM)
            os.waitpid(process, 0)


def _taken(waiting: int, files: Sequence[Sequence[pytest.Item]]) -> Iterator[pytest.Item]:
    """Yield the tests of the files that this shard takes from the pipe."""
    while index := os.read(waiting, _INDEX_BYTES):
        yield from files[int.from_bytes(index, "big")]


def _be_a_shard(session: pytest.Session, to: Connection, items: Iterator[pytest.Item]) -> None:
    """Run tests in a forked process, to its end."""
    plugins = session.config.pluginmanager
    plugins.unregister(name="terminalreporter")
    plugins.register(_Sender(session.config, to))
    code = 1
    try:
        _run_all(session, items)
        to.send(None)
        code = 0
    finally:
        # Skip the clean-up, which belongs to the main process.
        os._exit(code)


def _run_all(session: pytest.Session, items: Iterator[pytest.Item]) -> None:
    """Run tests; pytest keeps fixtures that the next test shares."""
    item = next(items, None)
    while item is not None:
        following = next(items, None)
        item.ihook.pytest_runtest_protocol(item=item, nextitem=following)
        _check_stop(session)
        item = following


def _pass_on_reports(session: pytest.Session, shards: dict[Connection, int]) -> None:
    """Pass the reports of the shards to pytest until all are done."""
    hook = session.config.hook
    at_work = dict.fromkeys(shards, "a first test")
    while at_work:
        for shard in wait(list(at_work)):
            assert isinstance(shard, Connection)
            try:
                message: Any = shard.recv()
            except EOFError:
                pytest.exit(f"a shard died in {at_work[shard]}", pytest.ExitCode.INTERNAL_ERROR)
            if message is None:
                del at_work[shard]
            elif isinstance(message, str):
                at_work[shard] = message
            else:
                report = hook.pytest_report_from_serializable(config=session.config, data=message)
                hook.pytest_runtest_logreport(report=report)
        _check_stop(session)


def _check_stop(session: pytest.Session) -> None:
    """Raise as pytest's own loop does, for example after `-x`."""
    if session.shouldfail:
        raise session.Failed(session.shouldfail)
    if session.shouldstop:
        raise session.Interrupted(session.shouldstop)
