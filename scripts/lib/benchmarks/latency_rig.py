"""Person and cameras of the latency's benchmark: a hold, and images of the needle where it is.

A process of its own, and as little work as cameras make a computer: images were drawn before.
"""

from __future__ import annotations

import random
import sys
import time
from collections import deque
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_srvs.srv import Trigger

from campaign.trials.rig_hand import CONTROLLER_START, RigHand
from needle_core.convert import Converter
from needle_core.errors import UserError
from needle_core.message_types import NANOSECONDS, rclpy_types, to_nanoseconds
from needle_core.ros.base_node import IMAGES
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.cameras import camera_info_message, image_message

IMAGES_FILE, INSERTIONS_FILE = "images.npy", "insertions.npy"
_PERIOD = 1.0 / 30.0
# Exposures keep no step with the driver's cycles.
_JITTER = 0.01
# From exposure to both images in the computer, as from a USB 3 camera [s].
_TRANSFER = 0.01
_JOINTS = 100
_BEFORE = 30
_PATIENCE = 60.0


class LatencyRig(RigHand):
    """Shows, and holds.

    Parameters
    ----------
    folder : Path
        Has images, (N, 2, height, width), and the insertion of each pair, (N,) [m].
    calibration : Path
        The cameras.
    """

    def __init__(self, folder: Path, calibration: Path) -> None:
        super().__init__()
        self._images = np.load(folder / IMAGES_FILE)
        self._insertions = np.load(folder / INSERTIONS_FILE)
        self._converter = Converter(rclpy_types())
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
        self._told: deque[tuple[int, float]] = deque([(0, 0.0)], maxlen=_JOINTS)
        self._random = random.Random(1)
        self._due = time.monotonic()
        self.shown = 0

    def insert(self, depth: float) -> None:
        """Prepare the rig, then hold until the needle is so deep [m]."""
        self.prepare()
        self._show_until(lambda: self.shown >= _BEFORE, "images")
        start = self._clients_of[CONTROLLER_START]
        self._show_until(start.service_is_ready, "the controller")
        while not self._has_started(start):
            shown = self.shown
            self._show_until(lambda least=shown: self.shown > least, "another image")
        self.send_hold()
        self._show_until(lambda least=self.shown: self.shown > least, "a release")
        self.pressed = True
        self._show_until(lambda: self._told[-1][1] >= depth, "the depth")
        self.pressed = False
        self.send_hold()

    def _has_started(self, start: Any) -> bool:
        future = start.call_async(Trigger.Request())
        self._show_until(future.done, "an answer of the controller")
        return bool(future.result().success)

    def _show_until(self, condition: Any, what: str) -> None:
        end = time.monotonic() + _PATIENCE
        while not condition():
            if time.monotonic() > end:
                raise UserError(f"waited {_PATIENCE:g} s in vain: {what}; device: {self.status}")
            wait = self._due - time.monotonic()
            self.look(max(wait, 0.0))
            if time.monotonic() >= self._due:
                self._show()
                # A camera that is late makes up for nothing.
                self._due = max(self._due, time.monotonic() - _PERIOD)
                self._due += _PERIOD + self._random.uniform(-_JITTER, _JITTER)

    def _show(self) -> None:
        exposed_ns = time.time_ns() - round(_TRANSFER * NANOSECONDS)
        times, insertions = (np.array(column) for column in zip(*self._told, strict=True))
        insertion = np.interp(exposed_ns - times[0], times - times[0], insertions)
        pair = self._images[int(np.argmin(np.abs(self._insertions - insertion)))]
        for pixels, (camera, frame, image, info) in zip(pair, self._views, strict=True):
            told = camera_info_message(camera, frame, exposed_ns)
            info.publish(self._converter.to_ros(told))
            image.publish(self._converter.to_ros(image_message(pixels, frame, exposed_ns)))
        self.shown += 1

    def _on_places(self, message: JointState, info: dict[str, int]) -> None:
        super()._on_places(message, info)
        self._told.append((to_nanoseconds(message.header.stamp), message.position[0]))


def main() -> None:
    """Insert as deep as the command line says."""
    folder, calibration, depth = sys.argv[1:]
    rclpy.init()
    with closing(LatencyRig(Path(folder), Path(calibration))) as rig:
        rig.insert(float(depth))
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
