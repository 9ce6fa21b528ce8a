"""Cameras of the simulated rig: a rendered stereo pair for each exposure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from needle_core import messages as m
from needle_core.component import Actions, Delivery, Output, Publish
from needle_core.files.installed import find_shared
from needle_sim.camera.image_folder import ImageFolder, truth_of
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import SCENARIOS
from needle_sim.camera.stereo_rig import SimulatedCamera, load_stereo_rig
from needle_sim.rig.bench import SimulatedBench
from needle_sim.sim_rig_parameters import SimRigParameters

_IMAGES = Delivery(depth=5)
_FRAMES = ("left_camera_optical", "right_camera_optical")
_CENTRELINE_SPACING = 0.001


class CameraSensor:
    """Levels with cameras: a rendered stereo pair.

    Parameters
    ----------
    bench : SimulatedBench
        What is seen.
    settings : SimRigParameters
        The rig's.
    """

    def __init__(self, bench: SimulatedBench, settings: SimRigParameters) -> None:
        self._bench = bench
        own = settings.calibration_file
        file = Path(own) if own else find_shared("needle_tracker", "config/calibration.yaml")
        rig = load_stereo_rig(str(file))
        self.half_sizes = (rig.half_height, rig.half_width)
        self._cameras = (rig.left, rig.right)
        scenario = SCENARIOS[settings.scenario]
        self._has_needle = scenario.needle
        self._needle = settings.needle
        self._renderer = StereoRenderer(rig, settings.seed, self._needle, scenario)
        self._folder: ImageFolder | None = None
        if settings.images:
            self._folder = ImageFolder(Path(settings.images).expanduser(), file)
        self.outputs = tuple(
            Output(f"stereo/{side}/{name}", kind, _IMAGES)
            for side in ("left", "right")
            for name, kind in (("image_raw", m.Image), ("camera_info", m.CameraInfo))
        )

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Return the images of an exposure, each after its camera_info."""
        pose = self._bench.plant.T_rig_tip
        line = self._bench.plant.centreline(_CENTRELINE_SPACING)
        images = self._renderer.render(pose, line, number)
        if self._folder is not None:
            self._folder.write(
                number,
                images,
                self._bench.insertion,
                truth_of(pose, self._needle) if self._has_needle and len(line) > 1 else None,
                self._renderer.share_seen(pose, line, number),
            )
        for side, image, frame, camera in zip(
            ("left", "right"), images, _FRAMES, self._cameras, strict=True
        ):
            yield Publish(
                f"stereo/{side}/camera_info", camera_info_message(camera, frame, stamp_ns)
            )
            yield Publish(f"stereo/{side}/image_raw", image_message(image, frame, stamp_ns))

    def close(self) -> None:
        """End the folder's files."""
        if self._folder is not None:
            self._folder.close()


def image_message(pixels: NDArray[np.uint8], frame: str, stamp_ns: int) -> m.Image:
    """Return a grey image."""
    height, width = pixels.shape
    return m.Image(stamp_ns, frame, height, width, "mono8", width, pixels.tobytes())


def camera_info_message(camera: SimulatedCamera, frame: str, stamp_ns: int) -> m.CameraInfo:
    """Return a camera's calibration; the images are not rectified."""
    matrix = camera.camera_matrix
    return m.CameraInfo(
        stamp_ns,
        frame,
        camera.image_height,
        camera.image_width,
        "plumb_bob",
        tuple(float(value) for value in camera.distortion),
        tuple(matrix.ravel().tolist()),
        tuple(np.eye(3).ravel().tolist()),
        tuple(np.hstack([matrix, np.zeros((3, 1))]).ravel().tolist()),
    )
