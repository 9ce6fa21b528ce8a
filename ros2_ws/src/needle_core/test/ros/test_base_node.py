"""A node's start and end, without a graph."""

import contextlib
import dataclasses
import os
import select
import signal
import subprocess
import sys

import pytest
from rclpy.node import Node

from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_INTERNAL_ERROR
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.process.end_request import ENDING_SIGNALS
from needle_core.process.ros_domain import FIRST_PARTICIPANT, own_domain, ports_of
from needle_core.process.shared_memory import SHARED_MEMORY
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node


@dataclasses.dataclass(frozen=True)
class NoParameters:
    """None."""


def run(create: type[Node], *words: str) -> int:
    return run_node(create, help_text="HELP", parameters=NoParameters, args=["node", *words])


class Signalled(Node):
    """Gets signals in the middle of a callback, which it ends."""

    def __init__(self) -> None:
        super().__init__("signalled")
        self.create_timer(1e-3, self._on_timer, clock=STEADY_CLOCK)

    def _on_timer(self) -> None:
        for number in ENDING_SIGNALS:
            os.kill(os.getpid(), number)
        assert self.context.ok()
        DiagnosticsPublisher(self).set("part", Diagnostic(Level.OK, "last words"))

    def destroy_node(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        super().destroy_node()


class Fails(Node):
    """Has a fault of its own."""

    def __init__(self) -> None:
        super().__init__("fails")
        self.create_timer(1e-3, self._on_timer, clock=STEADY_CLOCK)

    def _on_timer(self) -> None:
        raise RuntimeError("a fault of its own")


class Refuses(Node):
    """Does not like its parameters."""

    def __init__(self) -> None:
        raise UserError("rate = 0 Hz, must be > 0")


class MissesAnother(Node):
    """Misses what ended on the same signal."""

    def __init__(self) -> None:
        super().__init__("misses_another")
        os.kill(os.getpid(), signal.SIGINT)
        raise UserError("the link is lost")


def test_what_is_missed_after_a_signal_is_no_bad_input() -> None:
    assert run(MissesAnother) == EXIT_DONE


def test_signals_in_a_callback_and_at_the_end_are_a_clean_end() -> None:
    assert run(Signalled) == EXIT_DONE


def test_a_fault_in_a_callback_is_an_internal_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Fails) == EXIT_INTERNAL_ERROR
    assert "RuntimeError: a fault of its own (test_base_node.py:" in capsys.readouterr().err


def test_bad_parameters_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Refuses) == EXIT_BAD_INPUT
    assert capsys.readouterr().err == "error: rate = 0 Hz, must be > 0\n"


@pytest.mark.parametrize("word", ["--help", "-h"])
def test_help_is_given_without_a_context(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Refuses, word) == EXIT_DONE
    assert capsys.readouterr().out.startswith("HELP\n")


@pytest.mark.filterwarnings("ignore:Failed to fini rosout publisher:RuntimeWarning")
def test_a_namespace_that_ros_does_not_take_is_bad_input(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(Signalled, "--ros-args", "-r", "__ns:=/rig1/") == EXIT_BAD_INPUT
    assert capsys.readouterr().err.startswith("error: error creating node: invalid node namespace")


def test_an_unknown_argument_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Refuses, "--fast") == EXIT_BAD_INPUT
    assert "'--fast'" in capsys.readouterr().err


def test_a_parameter_before_ros_args_is_said_to_go_after(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(Refuses, "-p", "x:=1") == EXIT_BAD_INPUT
    assert "'-p'; it goes after --ros-args" in capsys.readouterr().err


def test_a_parameter_without_its_option_is_no_remapping(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Refuses, "rate:=1", "--ros-args", "-p", "other:=1") == EXIT_BAD_INPUT
    assert capsys.readouterr().err.endswith("is set by --ros-args -p rate:=1\n")


def test_a_node_begins_where_the_maker_of_a_port_ended_half_way() -> None:
    code = """
import sys
from rclpy.node import Node
from needle_core.ros.base_node import run_node
node = lambda: Node("one")
spin = lambda node, end: 7
sys.exit(run_node(node, help_text="", parameters=object, args=["one"], spin=spin))
"""
    with own_domain() as domain:
        # Of what the rig says to each other; discovery has the one before.
        port = ports_of(domain)[FIRST_PARTICIPANT + 1]
        (SHARED_MEMORY / f"fastrtps_port{port}").write_bytes(b"")
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=environment, timeout=30.0, check=False)
    assert done.returncode == 7


SAYS = """
import sys
import time
from rclpy.node import Node
from std_msgs.msg import String
from needle_core.ros.base_node import run_node
from needle_core.ros.conversions import RELIABLE

class Says(Node):
    def __init__(self):
        super().__init__("says")
        self.words = self.create_publisher(String, "words", RELIABLE)

    def destroy_node(self):
        print("goes", flush=True)
        super().destroy_node()

def spin(node, end):
    while not node.words.get_subscription_count():
        time.sleep(0.01)
    print("is listened to", flush=True)
    sys.stdin.readline()
    for number in range(10):
        node.words.publish(String(data=str(number)))
    print("has said it", flush=True)
    return 7

sys.exit(run_node(Says, help_text="", parameters=object, args=["says"], spin=spin))
"""
HEARS = """
import sys
from rclpy.node import Node
from std_msgs.msg import String
from rclpy.executors import SingleThreadedExecutor
from needle_core.ros.base_node import run_node
from needle_core.ros.conversions import RELIABLE

def spin(node, end):
    heard = []
    node.create_subscription(String, "words", lambda word: heard.append(word.data), RELIABLE)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while "9" not in heard:
        executor.spin_once(timeout_sec=0.1)
    print(*heard, flush=True)
    return 0

node = lambda: Node("hears")
sys.exit(run_node(node, help_text="", parameters=object, args=["hears"], spin=spin))
"""


def test_a_node_goes_when_what_it_said_has_reached_a_subscriber_that_stood_still() -> None:
    with own_domain() as domain, contextlib.ExitStack() as ends:

        def start(code: str) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(
                [sys.executable, "-c", code],
                env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                # Nothing is read ahead: what is left can be waited for.
                bufsize=0,
            )
            ends.enter_context(process)
            ends.callback(process.kill)
            return process

        says, hears = start(SAYS), start(HEARS)
        assert says.stdin is not None
        assert says.stdout is not None
        assert says.stdout.readline() == b"is listened to\n"
        hears.send_signal(signal.SIGSTOP)
        # It hears on until all of its threads stand still.
        os.waitid(os.P_PID, hears.pid, os.WSTOPPED)
        try:
            says.stdin.write(b"\n")
            assert says.stdout.readline() == b"has said it\n"
            assert select.select([says.stdout], [], [], 1.5)[0] == []
        finally:
            hears.send_signal(signal.SIGCONT)
        assert says.wait(30.0) == 7
        assert hears.communicate(timeout=30.0)[0].split() == b"0 1 2 3 4 5 6 7 8 9".split()
