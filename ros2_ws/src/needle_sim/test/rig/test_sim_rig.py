"""sim_rig as a component, called directly; whole rigs run in needle_bringup's test_virtual_run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from needle_core import messages as m
from needle_core.component import Action, Exit, Moment, PortChange, Publish
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import from_values
from needle_core.status_messages import ControllerStatus
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_sim.cameras import PublishedRemoteCameras
from needle_sim.sim_rig import SimRig
from needle_sim.sim_rig_parameters import SimRigParameters


def made(**parameters: Any) -> SimRig:
    return SimRig(from_values(SimRigParameters, {"level": "tip", **parameters}, "sim_rig"))


def run(rig: SimRig, begin: float, end: float) -> list[Any]:
    """Run both timers, cycles first; return the publications: topic and message."""
    actions: list[Action] = []
    for tick in range(round(begin * 50), round(end * 50)):
        at = Moment(tick / 50, tick * 20_000_000)
        for timer in rig.timers:
            actions += timer.handler(at)
    return [(one.topic, one.message) for one in actions if isinstance(one, Publish)]


def receive(rig: SimRig, topic: str, message: Any) -> None:
    (row,) = (row for row in rig.inputs if row.topic == topic)
    assert list(row.handler(message, Moment(0.0, 0))) == []


def test_tips_are_within_their_noise_of_the_truth_and_another_seed_draws_others() -> None:
    first, other = (made(seed=seed, initial_pitch=0.035, initial_roll=0.26) for seed in (1, 2))
    for rig in (first, other):
        receive(rig, "needle/controller_status", ControllerStatus(state="STEERING", awaiting="tip"))
    one, another = (run(rig, 0.0, 40.0) for rig in (first, other))
    tips = [message for topic, message in one if topic == "needle/tip"]
    truths = {m.stamp_ns: m.position for topic, m in one if topic == "sim/tip_pose"}
    assert len(tips) == len(truths) == 2000
    assert {tip.frame_id for tip in tips} == {"rig"}
    # Uniform within 1 mm of the truth, along each axis.
    off = np.array([np.subtract(tip.position, truths[tip.stamp_ns]) for tip in tips])
    assert 0.99e-3 < np.abs(off).max() <= 1e-3
    np.testing.assert_allclose(off.std(axis=0), 1e-3 / np.sqrt(3.0), rtol=0.03)
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=3e-5)
    (variances,) = {m.covariance[:15:7] for topic, m in one if topic == "needle/tip_pose"}
    assert variances == pytest.approx((1e-6 / 3.0,) * 3)
    assert [m for topic, m in another if topic == "sim/tip_pose"] == [
        m for topic, m in one if topic == "sim/tip_pose"
    ]
    assert [message for topic, message in another if topic == "needle/tip"] != tips


def test_at_level_drive_motors_move_the_needle_and_its_exit_triggers_the_stop() -> None:
    # Almost straight up: it leaves through the surface, 17.5 mm above.
    rig = made(level="drive", initial_pitch=1.4, curvature=0.0)
    names = (m.INSERTION_JOINT, m.ROTATION_JOINT)
    published = []
    for second, insertion in ((0.0, 0.001), (1.5, 0.02)):
        place = m.JointState(0, names, (insertion, 0.0), (0.0, 0.0))
        receive(rig, "sim/drive_positions", place)
        published += run(rig, second, second + 1.5)
    truth = next(message for topic, message in published if topic == "sim/tip_pose")
    assert math.hypot(truth.position[0], truth.position[2]) == pytest.approx(0.001)
    assert [stop.pressed for topic, stop in published if topic == "device/estop"] == [True]


def test_a_third_exposure_is_dropped_and_the_end_of_the_rendering_process_ends_the_rig() -> None:
    rig = SimRig(SimRigParameters(), new_sensor=PublishedRemoteCameras)
    (port,), at = rig.ports, Moment(0.0, 0)
    images = [Publish("stereo/left/image_raw", m.Text("pixels"))]
    assert [len(list(rig._sensor.expose(number, number))) for number in range(3)] == [1, 1, 0]
    assert list(port.handler((images,), at)) == images
    assert [len(list(rig._sensor.expose(number, number))) for number in range(3, 5)] == [1, 0]
    assert list(port.on_change(PortChange("ended"), at)) == [Exit(1, "ended")]


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"scenario": "fog"}, "scenario = 'fog' is not one of clean"),
        ({"scenario": "clutter"}, "scenario = 'clutter': level tip has no images"),
        ({"level": "camera", "images": "/dev/null/x"}, "cannot write /dev/null/x"),
        ({"level": "camera", "calibration_file": "/nowhere.yaml"}, "/nowhere.yaml"),
        # Hard caps cannot be configured away.
        ({"max_speed": 0.006}, "max_speed"),
    ],
)
def test_bad_parameters_are_refused_in_one_line(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        made(**parameters)


def test_given_limits_are_respected() -> None:
    given = {
        name: 0.9 * value
        for name, value in vars(SafetyLimits()).items()
        if name in vars(SimRigParameters())
    }
    assert len(given) > 5
    limits = SimRigParameters(**given).limits
    assert {name: getattr(limits, name) for name in given} == given
