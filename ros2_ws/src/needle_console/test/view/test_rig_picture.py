"""Snapshots and readings from messages of the rig."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from needle_console.view.readings import readings
from needle_console.view.rig_picture import RigPicture
from needle_console.view.snapshot import Snapshot, stop_reason
from needle_console.view.targets import plane_pose
from needle_core.status_messages import ControllerStatus, DeviceStatus

COVARIANCE = np.diag([1e-8, 4e-8, 9e-8])
STEERING = ControllerStatus(state="STEERING", starts=1, target_offset_m=0.003)
MINUS, NONE = "\N{MINUS SIGN}", "\N{EN DASH}"


def picture_of(*depths: float) -> RigPicture:
    picture = RigPicture()
    picture.set_controller(STEERING)
    for depth in depths:
        picture.set_joints(depth, 0.1, now=0.0)
        picture.add_estimate(np.array([-0.003 + depth / 50, 0.0, depth]), COVARIANCE)
    return picture


def test_outdated_joints_are_not_shown() -> None:
    picture = picture_of(0.01)
    assert picture.snapshot(0.9).insertion == 0.01
    assert math.isnan(picture.snapshot(1.1).insertion)
    assert readings(picture.snapshot(1.1))["Depth"] == NONE


def test_plane_is_shown_only_if_the_controller_accepted_it() -> None:
    picture = picture_of(0.01)
    tilted = plane_pose(9.0, 36.0)
    picture.set_plane(tilted)
    assert picture.snapshot(0.0).T_rig_plane[0, 3] == pytest.approx(0.003)
    picture.set_controller(dataclasses.replace(STEERING, target_offset_m=0.009))
    assert picture.snapshot(0.0).T_rig_plane == pytest.approx(tilted)


def test_reason_of_an_ended_hold_is_kept_while_pressed() -> None:
    moving = DeviceStatus(state="MOVING", hold_owner="console")
    silent = DeviceStatus(state="HOLDING", reason="no hold message for 0.105 s, limit 0.1 s")
    again = DeviceStatus(reason="hold of 'console' ignored (hold_new_press)")
    for statuses, why in (
        ((moving, silent, again, again), silent.reason),
        # A stalled console did not receive more.
        ((moving, again), again.reason),
    ):
        picture = RigPicture()
        for status in statuses:
            picture.set_device(status)
        device = picture.latest().device
        assert device is not None
        assert stop_reason(device) == why


def test_track_deepens_and_restarts() -> None:
    picture = picture_of(0.010, 0.011, 0.0111, 0.012)
    assert [point.depth for point in picture.snapshot(0.0).track] == [0.010, 0.0111, 0.012]
    picture.set_joints(0.0105, 0.1, now=0.0)
    assert len(picture.snapshot(0.0).shaft) == 2
    picture.add_estimate(np.array([0.0, 0.0, 0.0105]), COVARIANCE)
    assert [point.depth for point in picture.snapshot(0.0).track] == [0.010, 0.0105]
    picture.set_controller(ControllerStatus(state="STEERING", starts=2))
    assert picture.snapshot(0.0).track == ()


def test_age_of_a_lost_or_old_tip() -> None:
    picture = picture_of(0.01)
    picture.set_tip(np.array([0.0, -0.001, 0.01]), COVARIANCE, now=1.0)
    for now, text in ((1.5, f"0.0, {MINUS}1.0, 10.0 mm"), (2.9, "no images for 2 s")):
        assert readings(picture.snapshot(now))["Tip"] == text
    for now in (2.0, 3.0):
        picture.set_tip(np.zeros(3), np.full((3, 3), np.inf), now=now)
    assert picture.snapshot(4.5).tip_lost_for == pytest.approx(2.5)
    assert readings(picture.snapshot(4.5))["Tip"] == "not found for 2.5 s"


def test_non_finite_values_are_ignored() -> None:
    picture = picture_of(0.01)
    before = picture.snapshot(0.5)
    picture.set_joints(math.nan, 0.0, now=0.5)
    picture.add_estimate(np.array([math.inf, 0.0, 0.0]), COVARIANCE)
    picture.set_plane(np.full((4, 4), math.nan))
    after = picture.snapshot(0.5)
    assert after.insertion == before.insertion
    assert len(after.track) == len(before.track)
    assert np.isfinite(after.T_rig_plane).all()


def test_warnings_end_when_resolved_or_outdated() -> None:
    picture = RigPicture()
    picture.set_health("a: x", bad=True, message="broken\x07", now=0.0)
    picture.set_health("b: y", bad=True, message="late", now=0.0)
    assert picture.snapshot(0.1).warnings == ("a: x: broken?", "b: y: late")
    picture.set_health("b: y", bad=False, message="ok", now=0.2)
    assert picture.snapshot(0.3).warnings == ("a: x: broken?",)
    assert picture.snapshot(9.0).warnings == ()


def test_readings_are_in_mm_and_degrees() -> None:
    assert set(readings(Snapshot(DeviceStatus(), ControllerStatus())).values()) == {NONE}
    picture = picture_of(0.05)
    steering = dataclasses.replace(STEERING, depth_m=0.12, r1_low_m=-0.0025, r1_high_m=-0.0015)
    picture.set_controller(dataclasses.replace(steering, reachable=True, reachable_depth_m=0.043))
    shown = readings(picture.snapshot(0.0))
    assert shown["Depth"] == "50.0 mm of 120 mm"
    assert shown["Distance from plane"] == f"{MINUS}2.00 mm (95 %: {MINUS}2.50 to {MINUS}1.50)"
    assert shown["Rotation of the base"].startswith("5.7")
    assert shown["Reach"] == "the plane can be reached, from 43 mm on"
    picture.set_controller(dataclasses.replace(steering, reachable=False))
    assert readings(picture.snapshot(0.0))["Reach"] == "the plane is out of reach"
