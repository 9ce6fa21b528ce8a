"""Latency from both images to their set-points, in the whole graph of a rig in real time.

Tracker, controller, driver, recorder and console run as on a rig, with emulated drives. The cameras
publish images that were drawn before, so that no renderer competes for the CPU: a first insertion,
in one process, gives the path of the needle; the second one follows it. This file, run as a
program, is the process of the cameras and the operator.
"""

from __future__ import annotations

import os
import random
import socket
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from sensor_msgs.msg import CameraInfo, Image, JointState

import needle_tracker
from campaign.benchmarks.figure_rows import Row
from campaign.trials.ros_rig_client import CONTROLLER_START, RosRigClient
from campaign.trials.steered_needle import FRAME_RATE, OFFSET, steer
from campaign.trials.trial_processes import TrialProcesses
from needle_bags.reading.bag_reader import read_run
from needle_bags.run.stage_timing import stage_timings
from needle_bringup.simulation.rig_configuration import GRAPH_WATCHDOG, can_adapter
from needle_core.component import Actions
from needle_core.convert import to_ros
from needle_core.errors import UserError
from needle_core.message_types import NANOSECONDS, rclpy_types, to_nanoseconds
from needle_core.process.ros_domain import reserve_domain_id
from needle_core.ros.base_node import IMAGES
from needle_core.settings.parameter_files import Parameters
from needle_device_driver.conformance.rig import HandState
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.cameras import camera_info_message, image_message
from needle_sim.sensors import TipSensor

CALIBRATION = Path(needle_tracker.__file__).resolve().parents[1] / "config" / "calibration.yaml"
FRAME = 1.0 / FRAME_RATE
SPEED, DEPTH = 0.002, 0.030
# Images count from this insertion on; before, the tracker relies on the measured insertion [m].
FIRST = 0.006
# Spacing of the drawn images along the insertion [m].
_SPACING = 6e-5
_LOOPBACK = "127.0.0.1"
STAGES = ("tracker", "controller", "driver", "image to set-point")
_IMAGES_FILE, _INSERTIONS_FILE = "images.npy", "insertions.npy"
# Jitter of the exposures, so that they do not synchronize with the driver's cycles [s].
_JITTER = 0.01
# Time from exposure to the arrival of both images in the computer, as with a USB 3 camera [s].
_TRANSFER = 0.01
_JOINT_SAMPLES = 100
_PAIRS_BEFORE_START = 30
_TIMEOUT = 60.0


def rows(depth: float = DEPTH) -> Iterator[Row]:
    """Yield median and 99th percentile of each stage's time, over an insertion to a depth [m].

    Raises
    ------
    UserError
        If the needle does not reach the depth.
    """
    with tempfile.TemporaryDirectory(prefix="needle_bench_") as name:
        folder = Path(name)
        draw(folder, depth + OFFSET)
        _run(folder, depth)
        run = read_run(folder / "bag")
        timings = {timing.name: timing for timing in stage_timings(run)}
    for stage in STAGES:
        timing = timings[stage]
        seconds = timing.seconds[run.insertion_at(timing.stamps) > FIRST]
        key = f"latency_{stage.replace(' ', '_').replace('-', '_')}"
        for percent in (50, 99):
            value = 1e3 * float(np.percentile(seconds, percent))
            what = f"{stage}, p{percent}"
            yield Row(f"{key}_p{percent}", what, "ms", value, "a frame", 1e3 * FRAME)


class _DrawingSensor(TipSensor):
    """Sensor that measures the tip, and draws the needle along its path."""

    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self._renderer = StereoRenderer(load_stereo_rig(CALIBRATION), 1)
        self.insertions: list[float] = []
        self.images: list[tuple[np.ndarray, np.ndarray]] = []

    def expose(self, number: int, stamp_ns: int) -> Actions:
        bench = self._bench
        if not self.insertions or bench.insertion - self.insertions[-1] > _SPACING:
            self.insertions.append(bench.insertion)
            plant = bench.plant
            pose, line = plant.T_rig_tip, plant.centreline(1e-3)
            self.images.append(self._renderer.render(pose, line, number))
        return super().expose(number, stamp_ns)


def draw(folder: Path, depth: float) -> None:
    """Steer a needle in this process, and save images along its path in a folder."""
    sensors: list[_DrawingSensor] = []

    def make_sensor(*parts: Any) -> _DrawingSensor:
        sensors.append(_DrawingSensor(*parts))
        return sensors[0]

    hold = lambda seconds: HandState(pressed=seconds > 0.2)  # noqa: E731
    steer(hold, 1, latency=0.01, new_sensor=make_sensor, depth=depth, nominal_speed=SPEED)
    np.save(folder / _IMAGES_FILE, np.array(sensors[0].images))
    np.save(folder / _INSERTIONS_FILE, np.array(sensors[0].insertions))


def _run(folder: Path, depth: float) -> None:
    adapter = str(can_adapter())
    parameters: Parameters = {
        "recorder": {"bag": str(folder / "bag")},
        "drive_emulator": {"pty": adapter},
        # Emulated drives run in a process, which may answer late on a busy machine.
        "device_driver": {
            "channel": adapter,
            **dict.fromkeys(("watchdog", "reply_age_limit", "hold_timeout"), GRAPH_WATCHDOG),
        },
        "stereo_tracker": {},
        "plane_controller": {
            "insertion": "continuous",
            "target_offset": OFFSET,
            "depth": depth + OFFSET,
            "nominal_speed": SPEED,
        },
        "console": {"address": _LOOPBACK, **_free_ports()},
    }
    rig = [sys.executable, __file__, str(folder), str(CALIBRATION), str(depth)]
    with (
        reserve_domain_id() as domain,
        closing(TrialProcesses(folder, domain, parameters)) as graph,
    ):
        done = subprocess.run(
            rig,
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
            capture_output=True,
            text=True,
            check=False,
        )
        graph.check()
    if done.returncode:
        raise UserError(
            f"the needle did not reach the depth: {done.stderr.strip().splitlines()[-1]}"
        )


def _free_ports() -> dict[str, object]:
    """Return two free ports for the console's page and hold."""
    with socket.socket() as page, socket.socket() as hold:
        for each in (page, hold):
            each.bind((_LOOPBACK, 0))
        return {"port": page.getsockname()[1], "hold_port": hold.getsockname()[1]}


class LatencyRig(RosRigClient):
    """Cameras and operator: publishes the image drawn nearest to the insertion, and holds.

    Parameters
    ----------
    folder : Path
        Folder with images, (N, 2, height, width), and the insertion of each pair, (N,) [m].
    calibration : Path
        Calibration file of the cameras.
    """

    def __init__(self, folder: Path, calibration: Path) -> None:
        super().__init__()
        self._images = np.load(folder / _IMAGES_FILE)
        self._insertions = np.load(folder / _INSERTIONS_FILE)
        self._types = rclpy_types()
        rig = load_stereo_rig(calibration)
        self._views = [
            (
                camera,
                f"{side}_camera_optical",
                self.create_publisher(Image, f"stereo/{side}/image_raw", IMAGES),
                self.create_publisher(CameraInfo, f"stereo/{side}/camera_info", IMAGES),
            )
            for side, camera in (("left", rig.left), ("right", rig.right))
        ]
        self._joints: deque[tuple[int, float]] = deque([(0, 0.0)], maxlen=_JOINT_SAMPLES)
        self._random = random.Random(1)
        self._due = time.monotonic()
        self.published = 0

    def insert(self, depth: float) -> None:
        """Prepare the rig, then hold until the needle reaches a depth [m]."""
        self.prepare()
        self._publish_pairs(_PAIRS_BEFORE_START)
        self.call_until_success(CONTROLLER_START)
        self.send_hold()
        # A release must precede the press.
        self._publish_pairs(1)
        self.pressed = True
        self.until(lambda: self._joints[-1][1] >= depth, "the depth", _TIMEOUT)
        self.pressed = False
        self.send_hold()

    def spin(self, timeout: float = 0.0) -> None:
        """Run one callback, and publish a pair of images if it is due."""
        super().spin(min(timeout, max(self._due - time.monotonic(), 0.0)))
        if time.monotonic() >= self._due:
            self._publish_pair()
            # A camera that is late does not catch up.
            self._due = max(self._due, time.monotonic() - FRAME)
            self._due += FRAME + self._random.uniform(-_JITTER, _JITTER)

    def _publish_pairs(self, count: int) -> None:
        """Run until a number of further pairs has been published."""
        enough = self.published + count
        self.until(lambda: self.published >= enough, "images")

    def _publish_pair(self) -> None:
        exposed_ns = time.time_ns() - round(_TRANSFER * NANOSECONDS)
        times, insertions = (np.array(column) for column in zip(*self._joints, strict=True))
        insertion = np.interp(exposed_ns - times[0], times - times[0], insertions)
        pair = self._images[int(np.argmin(np.abs(self._insertions - insertion)))]
        for pixels, (camera, frame, image, info) in zip(pair, self._views, strict=True):
            camera_info = camera_info_message(camera, frame, exposed_ns)
            info.publish(to_ros(camera_info, self._types))
            pixels_message = image_message(pixels, frame, exposed_ns)
            image.publish(to_ros(pixels_message, self._types))
        self.published += 1

    def _on_joints(self, message: JointState, info: dict[str, int]) -> None:
        super()._on_joints(message, info)
        self._joints.append((to_nanoseconds(message.header.stamp), message.position[0]))


def main() -> None:
    """Run the cameras and the operator for an insertion to the depth on the command line."""
    folder, calibration, depth = sys.argv[1:]
    rclpy.init()
    with closing(LatencyRig(Path(folder), Path(calibration))) as rig:
        rig.insert(float(depth))
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
