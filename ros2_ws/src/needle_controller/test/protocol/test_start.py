"""What it takes to start steering."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from needle_controller.protocol.steering import Steering
from needle_controller.protocol.steering_types import Awaiting, SteeringState
from needle_core.status_messages import DeviceStatus

from .rig import HELD, MOVING, Rig, device, sent, where

ELSEWHERE = replace(device("HOLDING", True, ""), insertion_m=0.0, rotation_rad=0.0)


@pytest.mark.parametrize(
    ("device", "said"),
    [
        (None, "device/status"),
        (device("HOLDING", False, ""), "not homed"),
        (device("DISABLED", True, ""), "not enabled"),
        (device("ESTOPPED", True, ""), "not enabled"),
    ],
)
def test_start_says_why_not(device: DeviceStatus | None, said: str) -> None:
    rig = Rig(started=False)
    rig.steering._device = device
    reply, _ = rig.steering.on_start()
    assert not reply.success
    assert said in reply.message
    assert where(rig) == (SteeringState.IDLE, Awaiting.NOTHING)


def test_start_needs_joints() -> None:
    fresh = Steering(Rig(started=False).steering.settings)
    fresh.on_device(HELD)
    reply, _ = fresh.on_start()
    assert (reply.success, reply.message) == (False, "no joint_states have come")


def test_start_refuses_a_needle_it_did_not_follow() -> None:
    rig = Rig(started=False, insertion=0.05)
    reply, _ = rig.steering.on_start()
    assert not reply.success
    assert "0.05 m in" in reply.message


def test_start_refuses_a_roll_its_coordinates_cannot_say() -> None:
    rig = Rig(started=False, preset="paper", rotation=2.0)
    reply, _ = rig.steering.on_start()
    assert not reply.success
    assert "roll" in reply.message


@pytest.mark.parametrize("turned", [2.0, np.pi, -8.0])
def test_best_starts_with_its_base_turned_however_the_last_run_left_it(turned: float) -> None:
    rig = Rig(started=False, rotation=turned)
    assert rig.steering.on_start()[0].success
    assert sent(rig.expose()).rotation == pytest.approx(turned, abs=0.53)


def test_start_twice_and_stop_twice() -> None:
    rig = Rig()
    assert not rig.steering.on_start()[0].success
    assert rig.steering.on_stop()[0].success
    assert where(rig) == (SteeringState.IDLE, Awaiting.NOTHING)
    assert rig.steering.on_stop()[0].success


def test_tips_move_nothing_while_idle() -> None:
    rig = Rig(started=False)
    assert rig.expose() == []


@pytest.mark.parametrize(
    ("device", "said"),
    [
        (MOVING, "waiting for the device, which moves"),
        (device("MOVING", False, ""), "waiting for the device, which moves"),
        (ELSEWHERE, "waiting for joint_states"),
    ],
)
def test_a_start_waits_for_the_end_of_homing(device: DeviceStatus, said: str) -> None:
    """The joints lag behind the device: homing has ended there, and not here."""
    rig = Rig(started=False, insertion=0.0015)
    rig.steering.on_device(device)
    reply, _ = rig.steering.on_start()
    assert not reply.success
    assert reply.message.startswith(said)
    rig.insertion = 0.0
    rig.settle()
    rig.steering.on_device(replace(ELSEWHERE, hold_owner="operator"))
    assert rig.steering.on_start()[0].success
    sent(rig.expose())


NEVER_COMPILED = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from needle_controller.model.target_plane import offset_plane
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import PlaneControl

def compiled():
    every = (vars(module) for name, module in sys.modules.items() if "needle_" in name)
    found = [one for names in every for one in names.values() if isinstance(one, Dispatcher)]
    return {f"{one.py_func.__module__}.{one.__name__}": len(one.signatures) for one in found}

control = PlaneControl(SteeringSettings(preset=sys.argv[1], **PAPER_NOISE), offset_plane(0.003))
ahead = compiled()
for step in range(20):
    joints = JointSample(step, step * 0.001, 0.1 * step)
    control.update(np.array([0.0, 0.0, step * 0.001]), joints)
assert ahead and compiled() == ahead, (ahead, compiled())
"""


@pytest.mark.parametrize("preset", ["best", "paper"])
def test_nothing_is_compiled_while_a_needle_is_steered(preset: str) -> None:
    """In a process of its own: what another test has compiled hides what is missing."""
    command = [sys.executable, "-c", NEVER_COMPILED, preset]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
