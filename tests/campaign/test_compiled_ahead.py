"""No code is compiled while a needle is steered, which would delay it."""

from __future__ import annotations

import subprocess
import sys

import pytest

NEVER_COMPILED = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import PlaneControl

def compiled():
    every = (vars(module) for name, module in sys.modules.items() if "needle_" in name)
    found = [one for names in every for one in names.values() if isinstance(one, Dispatcher)]
    return {f"{one.py_func.__module__}.{one.__name__}": len(one.signatures) for one in found}

control = PlaneControl(SteeringSettings(preset=sys.argv[1], target_offset=0.003, **PAPER_NOISE))
ahead = compiled()
for step in range(20):
    joints = JointSample(step, step * 0.001, 0.1 * step)
    control.update(np.array([0.0, 0.0, step * 0.001]), joints)
assert ahead and compiled() == ahead, (ahead, compiled())
"""


@pytest.mark.parametrize("preset", ["best", "paper"])
def test_nothing_is_compiled_while_a_needle_is_steered(preset: str) -> None:
    """Run in a separate process, because code compiled by other tests would hide missing code."""
    command = [sys.executable, "-c", NEVER_COMPILED, preset]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
