"""What is heard becomes snapshots; what is old or makes no sense does not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from needle_console.view.readings import readings
from needle_console.view.rig_picture import RigPicture
from needle_console.view.snapshot import Snapshot, trouble_of
from needle_console.view.targets import plane_pose
from needle_core.status_messages import ControllerStatus, DeviceStatus

COVARIANCE = np.diag([1e-8, 4e-8, 9e-8])


def seen(*depths: float) -> RigPicture:
    picture = RigPicture()
    picture.see_controller(
        ControllerStatus.parse({"state": "STEERING", "starts": "1", "target_offset_m": "0.003"})
    )
    for depth in depths:
        picture.see_joints(depth, 0.1, now=0.0)
        picture.see_estimate(np.array([-0.003 + depth / 50, 0.0, depth]), COVARIANCE)
    return picture


def test_joints_that_fall_silent_are_not_shown_as_if_they_were_there() -> None:
    picture = seen(0.01)
    assert picture.snapshot(0.9).insertion == 0.01
    assert math.isnan(picture.snapshot(1.1).insertion)
    assert readings(picture.snapshot(1.1))["Depth"] == "\N{EN DASH}"


def test_estimates_are_placed_in_rig_by_the_plane_in_force() -> None:
    (point,) = seen(0.05).snapshot(0.0).course
    assert point.r1 == pytest.approx(-0.002)
    assert point.position == pytest.approx([0.001, 0.0, 0.05])
    assert point.sigma == pytest.approx(1e-4)


def test_estimates_in_a_tilted_plane_are_turned_into_rig() -> None:
    picture = seen()
    picture.see_plane(plane_pose(3.0, 30.0))
    picture.see_joints(0.05, 0.1, now=0.0)
    # On the plane, 50 mm along it.
    picture.see_estimate(np.array([0.0, 0.0, 0.05]), np.diag([0.0, 0.0, 1e-6]))
    (point,) = picture.snapshot(0.0).course
    along = np.array([0.5, 0.0, math.sqrt(0.75)])
    normal = np.array([math.sqrt(0.75), 0.0, -0.5])
    assert point.position == pytest.approx(0.003 * normal + 0.05 * along)
    assert point.covariance == pytest.approx(1e-6 * np.outer(along, along))


def test_a_plane_that_the_controller_did_not_take_is_not_shown() -> None:
    picture = seen(0.01)
    tilted = plane_pose(9.0, 36.0)
    picture.see_plane(tilted)
    assert picture.snapshot(0.0).T_rig_plane[0, 3] == pytest.approx(0.003)
    picture.see_controller(
        ControllerStatus.parse({"state": "STEERING", "starts": "1", "target_offset_m": "0.009"})
    )
    assert picture.snapshot(0.0).T_rig_plane == pytest.approx(tilted)


def test_why_the_device_ended_a_hold_outlasts_that_the_press_goes_on() -> None:
    picture = RigPicture()
    silent = "no hold message for 0.105 s, limit 0.1 s"
    goes_on = "hold of 'console' does not count (hold_new_press)"
    values = {"state": "HOLDING", "reason": goes_on, "press_again": "console"}
    for told in (
        {"state": "MOVING", "hold_owner": "console"},
        {"state": "HOLDING", "reason": silent},
        values,
        {**values, "speed_scale": "0"},
    ):
        picture.see_device(DeviceStatus.parse(told))
    device = picture.states().device
    assert device is not None
    assert (device.press_again, trouble_of(device)) == ("console", silent)
    # Where the console stood still itself, it heard no more than that.
    picture = RigPicture()
    for told in ({"state": "MOVING", "hold_owner": "console"}, values):
        picture.see_device(DeviceStatus.parse(told))
    device = picture.states().device
    assert device is not None
    assert trouble_of(device) == goes_on
    stamps = "hold of 'console' does not count (hold_in_order); device/reset ends this"
    picture.see_device(DeviceStatus.parse({**values, "reason": stamps}))
    device = picture.states().device
    assert device is not None
    assert trouble_of(device) == stamps


def test_a_controller_that_is_gone_steers_no_longer() -> None:
    picture = seen(0.01)
    picture.lose_controller()
    assert picture.states().controller is None
    assert picture.snapshot(0.0).controller is None
    picture.see_controller(ControllerStatus.parse({"state": "STEERING", "starts": "1"}))
    assert picture.states().controller is not None


def test_a_course_goes_deeper_only_and_a_new_start_begins_a_new_one() -> None:
    picture = seen(0.010, 0.011, 0.0111, 0.012)
    assert [point.depth for point in picture.snapshot(0.0).course] == [0.010, 0.0111, 0.012]
    picture.see_joints(0.0105, 0.1, now=0.0)
    assert len(picture.snapshot(0.0).shaft) == 2
    picture.see_estimate(np.array([0.0, 0.0, 0.0105]), COVARIANCE)
    assert [point.depth for point in picture.snapshot(0.0).course] == [0.010, 0.0105]
    picture.see_controller(ControllerStatus.parse({"state": "STEERING", "starts": "2"}))
    assert picture.snapshot(0.0).course == ()


def test_a_tip_that_is_lost_says_for_how_long() -> None:
    picture = seen(0.01)
    picture.see_tip(np.array([0.0, 0.0, 0.01]), COVARIANCE, now=1.0)
    assert picture.snapshot(1.5).tip_lost_for == 0.0
    for now in (2.0, 3.0):
        picture.see_tip(np.zeros(3), np.full((3, 3), np.inf), now=now)
    assert picture.snapshot(4.5).tip_lost_for == pytest.approx(2.5)
    assert readings(picture.snapshot(4.5))["Tip"] == "not found for 2.5 s"


def test_numbers_that_are_none_change_nothing() -> None:
    picture = seen(0.01)
    before = picture.snapshot(0.5)
    picture.see_joints(math.nan, 0.0, now=0.5)
    picture.see_estimate(np.array([math.inf, 0.0, 0.0]), COVARIANCE)
    picture.see_plane(np.full((4, 4), math.nan))
    after = picture.snapshot(0.5)
    assert after.insertion == before.insertion
    assert len(after.course) == len(before.course)
    assert np.isfinite(after.T_rig_plane).all()


def test_troubles_end_when_they_are_mended_or_no_longer_told() -> None:
    picture = RigPicture()
    picture.see_health("a: x", bad=True, message="broken\x07", now=0.0)
    picture.see_health("b: y", bad=True, message="late", now=0.0)
    assert picture.snapshot(0.1).troubles == ("a: x: broken?", "b: y: late")
    picture.see_health("b: y", bad=False, message="ok", now=0.2)
    assert picture.snapshot(0.3).troubles == ("a: x: broken?",)
    assert picture.snapshot(9.0).troubles == ()


def test_statuses_that_say_nothing_sensible_become_states_without_numbers() -> None:
    controller = ControllerStatus.parse(
        {"state": "IDLE", "depth_m": "nan", "target_point_m": "1, x, 3"}
    )
    assert controller.depth_m is None
    assert controller.target_point_m is None
    assert controller.reachable is None
    assert DeviceStatus.parse({"simulated": "yes"}).simulated is False
    assert set(readings(Snapshot(DeviceStatus.parse({}), controller)).values()) == {"\N{EN DASH}"}


def test_readings_are_in_mm_and_degrees() -> None:
    picture = seen(0.05)
    picture.see_controller(
        ControllerStatus.parse(
            {
                "state": "STEERING",
                "starts": "1",
                "depth_m": "0.12",
                "target_offset_m": "0.003",
                "r1_low_m": "-0.0025",
                "r1_high_m": "-0.0015",
                "reachable": "true",
                "reachable_depth_m": "0.043",
            }
        )
    )
    minus = "\N{MINUS SIGN}"
    told = readings(picture.snapshot(0.0))
    assert told["Depth"] == "50.0 mm of 120 mm"
    assert told["Off the plane"] == f"{minus}2.00 mm (95 %: {minus}2.50 to {minus}1.50)"
    assert told["Turn of the base"].startswith("5.7")
    assert told["Reach"] == "the plane can be reached, from 43 mm on"
