"""Whatever comes in whatever order: what must hold of two drives on a bus."""

from __future__ import annotations

from collections.abc import Callable

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

from needle_device_driver.supervisor.states import Activity, State

from .drive_bench import DriveBench

FURTHEST = {0x301: 0.005 * 0.02 * 20e6 * 1.02 + 2, 0x302: 3.1416 * 0.02 * 10430.4 * 1.02 + 2}


def retract(bench: DriveBench) -> None:
    bench.supervisor.retract(bench.clock())


def step(bench: DriveBench) -> None:
    if bench.supervisor.joints(bench.clock()) is not None:
        bench.step(0.001, 0.3, 0.25)


def home(bench: DriveBench) -> None:
    bench.supervisor.confirm_needle_out(True)
    bench.run(bench.supervisor.home(bench.clock()))


def reboot(bench: DriveBench) -> None:
    bench.rotation.reboot()
    bench.bus.flush()


def fail(bench: DriveBench) -> None:
    bench.insertion.fail(0x7121)
    bench.bus.flush()


def lose(bench: DriveBench) -> None:
    bench.broken = "gone"


EVENTS: dict[str, Callable[[DriveBench], object]] = {
    "press": lambda bench: bench.hold(True),
    "release": lambda bench: bench.hold(False),
    "silence": lambda bench: setattr(bench, "now", bench.now + 0.3),
    "enable": lambda bench: bench.supervisor.enable(True, bench.clock()),
    "disable": lambda bench: bench.supervisor.enable(False, bench.clock()),
    "stop": lambda bench: bench.supervisor.stop(),
    "estop": lambda bench: bench.supervisor.receive_estop(True),
    "estop off": lambda bench: bench.supervisor.receive_estop(False),
    "step": step,
    "retract": retract,
    "reset": lambda bench: bench.run(bench.supervisor.reset(bench.clock())),
    "home": home,
    "reboot": reboot,
    "fail": fail,
    "lose": lose,
    "switch off": lambda bench: setattr(bench.rotation, "state", "disabled"),
}
# A way into the middle of things, so that faults do not only meet a device at rest.
UNDER_WAY = ["home", "wait", "enable", "release", "press", "step"]


def targets(frames: list[tuple[int, bytes]]) -> list[tuple[int, int]]:
    return [
        (cob, int.from_bytes(data, "little", signed=True))
        for cob, data in frames
        if cob in FURTHEST
    ]


def cycle(bench: DriveBench) -> None:
    """Run a cycle and check what must hold of each."""
    before = bench.positions
    may_move = bench.supervisor.activity is not Activity.NONE
    homing = bench.supervisor.activity is Activity.HOMING
    standing = {0x301: before[0], 0x302: before[1]}
    sent = len(bench.bus.sent)
    bench.cycle(1)
    if homing or bench.insertion.homing_for >= 0 or bench.rotation.homing_for >= 0:
        return
    if not may_move:
        assert bench.positions == before
    drives = {0x301: bench.insertion, 0x302: bench.rotation}
    for cob, target in targets(bench.bus.sent[sent:]):
        # Only a drive that is on follows.
        if drives[cob].state == "enabled":
            assert abs(target - standing[cob]) <= FURTHEST[cob]
    if bench.state in (State.FAULT, State.ESTOPPED, State.DISABLED):
        assert bench.supervisor.activity is Activity.NONE


@settings(
    max_examples=20,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    prefix=st.sampled_from([[], UNDER_WAY]),
    names=st.lists(st.sampled_from(sorted(EVENTS)), min_size=1, max_size=10),
)
@pytest.mark.usefixtures("make_drive_bench")
def test_nothing_moves_that_was_not_let_go(
    make_drive_bench: Callable[..., DriveBench], prefix: list[str], names: list[str]
) -> None:
    bench = make_drive_bench()
    bench.configured()
    for name in [*prefix, *names]:
        if name == "wait":
            for _ in range(16):
                cycle(bench)
            continue
        words = len(bench.bus.sent)
        EVENTS[name](bench)
        if name != "reset":
            # Nothing but a reset acknowledges a fault.
            frames = bench.bus.sent[words:]
            assert not [d for c, d in frames if c in (0x201, 0x202) and d[0] & 0x80]
        for _ in range(4):
            cycle(bench)
    bench.close()
