"""Simulated node processes of a rig: start, supervision, and ordered end."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar
from unittest import mock

import pytest

from needle_bringup.simulation import console, node_graph, simulate
from needle_bringup.simulation.console import parse_console, rig_parameters
from needle_bringup.simulation.node_graph import NodeFailedError, NodeGraph, NodeProcess, stop
from needle_bringup.simulation.rig_configuration import PACKAGES
from needle_bringup.simulation.simulate_options import parse
from needle_core.errors import UserError
from needle_core.process.shutdown import ShutdownFlag
from needle_core.settings.parameter_files import NODES, read_parameters
from reference.rig_nodes import executables

INT, TERM, KILL = signal.SIGINT, signal.SIGTERM, signal.SIGKILL
DRIVE_NODES = (
    *("recorder", "sim_rig", "drive_emulator", "device_driver", "stereo_tracker"),
    *("plane_controller", "simulated_operator"),
)


class Played(NodeProcess):
    """Simulated process of a node; it ends on the signals that it handles."""

    all: ClassVar[dict[str, Played]] = {}
    sent: ClassVar[list[tuple[str, signal.Signals]]] = []
    ended: ClassVar[dict[str, int]] = {}
    """Exit codes of nodes that end by themselves."""

    def __init__(
        self,
        name: str,
        command: Sequence[str] = (),
        *,
        environment: Mapping[str, str] = {},
        log: Path,
        pass_fds: Sequence[int] = (),
    ) -> None:
        self.name, self.log, self.command = name, log, list(command)
        log.touch()
        self.environment, self.kept_open = dict(environment), list(pass_fds)
        self.code = self.ended.get(name)
        self.heeds = {INT, KILL}
        self.all[name] = self

    @property
    def exit_code(self) -> int | None:
        return self.code

    def signal_group(self, number: signal.Signals) -> None:
        self.sent.append((self.name, number))
        if self.code is None and number in self.heeds:
            self.code = -number if number is KILL else 0


@pytest.fixture(autouse=True)
def played(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate every node, and do not wait for one that stays."""
    for kept in (Played.all, Played.sent, Played.ended):
        kept.clear()
    monkeypatch.setattr(node_graph, "NodeProcess", Played)
    monkeypatch.setattr(node_graph, "TERMINATE_GRACE", 0.0)


def test_every_executable_is_a_known_node_of_parameter_files() -> None:
    assert {name for _, name, _ in executables("node")} == set(NODES)


def test_a_process_that_ignores_signals_is_killed_and_named(tmp_path: Path) -> None:
    orderly, slow, stubborn = (Played(name, log=tmp_path / name) for name in ("a", "b", "c"))
    slow.heeds, stubborn.heeds = {TERM, KILL}, {KILL}
    (line,) = stop([orderly, slow, stubborn], grace=0.0)
    assert line == "c did not end on SIGINT and SIGTERM, killed"
    assert [number for name, number in Played.sent if name == "b"] == [INT, TERM, KILL]
    assert (orderly.exit_code, slow.exit_code, stubborn.exit_code) == (0, 0, -KILL)


def test_the_end_of_a_node_is_described_with_its_last_line(tmp_path: Path) -> None:
    node = Played("node", log=tmp_path / "node.log")
    assert node.describe_end() == "node runs"
    assert node.last_line == ""
    node.log.write_bytes(b"one\ntwo\nerror: no \xff bus\n \n")
    node.code = 3
    assert node.describe_end() == "node ended with exit code 3: no \ufffd bus"
    node.code = -TERM
    assert "signal SIGTERM" in node.describe_end()


def test_a_graph_ends_in_order_and_warns_of_recording_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    graph = NodeGraph(tmp_path, {"sim_rig": {"level": "tip"}}, EXTRA="x")
    for name in DRIVE_NODES:
        graph.start(PACKAGES[name], name)
    assert read_parameters(tmp_path / "parameters.yaml", NODES) == {"sim_rig": {"level": "tip"}}
    driver = Played.all["device_driver"]
    assert driver.command[-2:] == ["--params-file", str(tmp_path / "parameters.yaml")]
    assert driver.environment["EXTRA"] == "x"
    graph.check()
    recorder = Played.all["recorder"]
    recorder.code = 1
    recorder.log.write_text("error: the disk is full\n")
    with pytest.raises(NodeFailedError, match=r"recorder ended.*disk is full.*recorder\.log"):
        graph.check()
    graph.stop()
    ended = [name for name, number in Played.sent if number is KILL]
    assert ended[:2] == ["simulated_operator", "device_driver"]
    assert ended[-1] == "recorder"
    assert set(ended) == set(DRIVE_NODES)
    assert capsys.readouterr().err == "warning: the disk is full\n"


def run_graph(bag: Path) -> int:
    """Run `simulate --graph` at level drive."""
    with mock.patch.dict(os.environ), mock.patch.object(simulate, "_report", lambda *_: 0):
        return simulate.simulate(parse(["--level", "drive", "--graph", "--bag", str(bag)]))


def test_a_graph_runs_until_its_operator_ends(tmp_path: Path) -> None:
    Played.ended["simulated_operator"] = 1
    assert run_graph(tmp_path / "bag") == 0
    assert tuple(Played.all) == DRIVE_NODES
    assert {node.environment["ROS_DOMAIN_ID"] for node in Played.all.values()} != {""}
    operator = Played.all["simulated_operator"]
    # Only the progress is printed to the terminal.
    assert operator.environment["NEEDLE_PROGRESS_FD"] == str(operator.kept_open[0])
    assert all(node.exit_code is not None for node in Played.all.values())


def test_bad_input_leaves_nothing_and_a_failure_leaves_its_logs(tmp_path: Path) -> None:
    for name, code, is_left in (
        ("device_driver", 2, False),
        ("device_driver", 3, True),
        ("simulated_operator", 2, True),
    ):
        bag = tmp_path / f"{name}_{code}"
        Played.ended.clear()
        Played.ended[name] = code
        with pytest.raises(UserError, match=f"{name} ended with exit code"):
            run_graph(bag)
        assert bag.exists() is is_left
        assert (bag / "parameters.yaml").is_file() is is_left


def test_an_interrupt_while_nodes_start_ends_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: Callable[..., NodeProcess] = NodeGraph.start

    def start(self: NodeGraph, package: str, name: str, pass_fds: Sequence[int] = ()) -> None:
        started(self, package, name, pass_fds)
        if name == "device_driver":
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(NodeGraph, "start", start)
    with pytest.raises(KeyboardInterrupt):
        run_graph(tmp_path / "bag")
    assert tuple(Played.all) == DRIVE_NODES[:4]
    assert all(node.exit_code is not None for node in Played.all.values())
    assert not (tmp_path / "bag").exists()


def test_the_console_graph_has_page_and_live_view(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    end = ShutdownFlag()

    def wait(nodes: Sequence[NodeProcess], _: float) -> list[NodeProcess]:
        end.requested = True
        return []

    monkeypatch.setattr(node_graph, "wait_for", wait)
    options = parse_console(["--graph", "--port", "9000"])
    with end, mock.patch.dict(os.environ):
        assert console.run_nodes(options, rig_parameters(options), end) == 130
    rig = ["sim_rig", "stereo_tracker", "plane_controller"]
    assert list(Played.all) == [*rig, "console", "live_view"]
    assert "http://127.0.0.1:9000/" in capsys.readouterr().out
    assert all(node.exit_code == 0 for node in Played.all.values())
