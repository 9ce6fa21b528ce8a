"""The component that publishes image pairs, and the thread that reads their source."""

from __future__ import annotations

import queue
from typing import Any
from unittest import mock

import numpy as np
import pytest

from needle_core.component import (
    Action,
    Diagnose,
    Exit,
    Log,
    Moment,
    Peers,
    PortChange,
    Publish,
    Send,
)
from needle_core.diagnostics import Level
from needle_core.errors import UserError
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.sources.stereo_source import EndOfRecording, PairPort, StampedPair
from needle_tracker.stereo_camera import PAIRS, StereoCamera, StereoCameraParameters

ASK = Send(PAIRS, ("next",))


class Rig:
    """The component, called directly in virtual time."""

    def __init__(self, calibration: StereoCalibration, **parameters: Any) -> None:
        self.camera = StereoCamera(StereoCameraParameters(**parameters), calibration)
        self.pixels = np.full((calibration.left.height, calibration.left.width), 5, np.uint8)
        self.tick, self.report = (timer.handler for timer in self.camera.timers)
        self.first = list(self.tick(Moment(0.0, 0)))

    def asks(self, seconds: float) -> bool:
        """Run a tick; return whether it requests a pair."""
        return ASK in list(self.tick(Moment(seconds, 0)))

    def gives(self, event: Any, seconds: float = 0.0) -> list[Action]:
        """Return the actions of the component after an event of the source."""
        return list(self.camera.ports[0].handler((event,), Moment(seconds, 0)))

    def pair(self, left_ns: int = 0, right_ns: int = 0) -> StampedPair:
        return StampedPair(self.pixels, self.pixels + 10, left_ns, right_ns)

    def health(self, seconds: float) -> tuple[Level, str, dict[str, str]]:
        (action,) = self.report(Moment(seconds, 0))
        assert isinstance(action, Diagnose)
        assert action.part == "images"
        return action.diagnostic.level, action.diagnostic.message, dict(action.diagnostic.values)


def published(actions: list[Action]) -> dict[str, Any]:
    return {action.topic: action.message for action in actions if isinstance(action, Publish)}


def test_a_pair_is_published_with_its_calibration(calibration: StereoCalibration) -> None:
    rig = Rig(calibration, rate=10.0)
    assert rig.first == [Log("info", "publishes images at 10 Hz"), ASK]
    sent = published(rig.gives(rig.pair(7, 9)))
    assert set(sent) == {output.topic for output in StereoCamera.outputs}
    image, info = sent["stereo/right/image_raw"], sent["stereo/right/camera_info"]
    camera = calibration.right
    assert (image.width, image.height) == (info.width, info.height) == (camera.width, camera.height)
    assert (image.encoding, image.step, set(image.data)) == ("mono8", camera.width, {15})
    assert image.frame_id == info.frame_id == "right_camera_optical"
    assert image.stamp_ns == info.stamp_ns == 9
    left = sent["stereo/left/image_raw"]
    assert left.stamp_ns == 7
    # Not copied.
    assert np.shares_memory(np.frombuffer(left.data, np.uint8), rig.pixels)
    np.testing.assert_allclose(np.reshape(info.k, (3, 3)), camera.camera_matrix)
    np.testing.assert_allclose(info.d, camera.distortion)


def test_stamps_exclude_the_latency_and_are_equal_for_a_triggered_pair(
    calibration: StereoCalibration,
) -> None:
    for triggered, right_ns in ((False, 7_000_000), (True, 5_000_000)):
        rig = Rig(calibration, latency=0.001, triggered=triggered)
        sent = published(rig.gives(rig.pair(6_000_000, 8_000_000)))
        assert sent["stereo/left/image_raw"].stamp_ns == 5_000_000
        assert sent["stereo/right/image_raw"].stamp_ns == right_ns
        assert rig.health(0.1)[2]["skew_max_ms"] == "2.00"


def test_one_pair_at_a_time_is_requested(calibration: StereoCalibration) -> None:
    """A slow camera gets the next request after its answer, not a tick later."""
    rig = Rig(calibration)
    assert not rig.asks(0.05)
    assert not rig.asks(0.10)
    assert ASK in rig.gives(rig.pair())
    assert ASK not in rig.gives(rig.pair())
    assert rig.asks(0.15)


def test_it_begins_when_both_images_have_subscribers(calibration: StereoCalibration) -> None:
    rig = Rig(calibration, wait_for_subscribers=True)
    left, right = ((f"stereo/{side}/image_raw", ("viewer",)) for side in ("left", "right"))
    assert rig.health(0.0)[:2] == (Level.WARN, "waiting for subscribers")
    for topics, asks in (((left,), False), ((left, right), True)):
        list(rig.camera.on_peers(Peers(subscribers=dict(topics)), Moment(0.1, 0)))
        assert rig.asks(0.2) == asks
    assert rig.health(0.3)[:2] == (Level.OK, "images published")


def test_a_low_rate_is_reported(calibration: StereoCalibration) -> None:
    rig = Rig(calibration, rate=10.0)
    for step in range(40):
        rig.gives(rig.pair(), 0.1 * step)
    assert rig.health(3.9)[:2] == (Level.OK, "images published")
    for step in range(40, 60):
        rig.gives(rig.pair(), 4.0 + 0.5 * (step - 40))
    level, message, values = rig.health(13.5)
    assert (level, message) == (Level.WARN, "slower than the 10 Hz requested")
    assert (values["pairs"], values["rate_hz"]) == ("60", "2.0")


def test_an_unreadable_pair_is_logged_and_counted(calibration: StereoCalibration) -> None:
    rig = Rig(calibration)
    assert rig.gives(None) == [Log("warning", "a pair could not be read", kind="unreadable")]
    level, message, values = rig.health(0.1)
    assert (level, message) == (Level.WARN, "some pairs could not be read")
    assert (values["pairs"], values["dropped"]) == ("0", "1")
    assert rig.asks(0.2)


def test_the_end_of_a_recording_reports_missing_frames(calibration: StereoCalibration) -> None:
    rig = Rig(calibration)
    rig.gives(None)
    rig.gives(rig.pair())
    rig.asks(0.1)
    rig.asks(0.2)
    end = Log("info", "end of the recording: 1 pairs, 1 unreadable")
    lacks = Log("warning", "the recording is incomplete: 2 frames without a partner")
    events = (EndOfRecording("2 frames without a partner"), EndOfRecording())
    assert [rig.gives(event) for event in events] == [[end, lacks, Exit(0)], [end, Exit(0)]]


def test_pairs_are_requested_at_the_rate_until_the_camera_is_lost(
    calibration: StereoCalibration,
) -> None:
    camera = Rig(calibration, rate=20.0).camera
    assert camera.timers[0].period == 1.0 / 20.0
    (port,) = camera.ports
    assert list(port.on_change(PortChange("unplugged?"), Moment(0.0, 0))) == [Exit(2, "unplugged?")]


def test_a_thread_reads_the_source() -> None:
    source, arrived = mock.MagicMock(), queue.SimpleQueue[Any]()
    given = (EndOfRecording("all"), None, UserError("unplugged?"), ZeroDivisionError())
    source.__next__ = mock.Mock(side_effect=given)
    port = PairPort(source)
    port.open(arrived.put)
    for _ in given:
        port.send(("next",))
    end, unreadable, lost, mistake = (arrived.get(timeout=60.0) for _ in given)
    assert (end(), unreadable()) == ((EndOfRecording("all"),), (None,))
    assert lost == PortChange("unplugged?")
    # An internal error ends the node that receives it.
    with pytest.raises(ZeroDivisionError):
        mistake()
    port.close()
    source.close.assert_called_once_with()
