"""Cameras of the simulated rig: a rendered stereo pair for each exposure."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from needle_core import messages as m
from needle_core.component import IMAGES, Actions, Output, Port, Publish, Send
from needle_core.files.installed import find_shared
from needle_sim.camera.image_folder import ImageFolder, truth_of
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import SCENARIOS
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig, load_stereo_rig
from needle_sim.rig.bench import SimulatedBench
from needle_sim.sim_rig_parameters import SimRigParameters

CAMERAS = "cameras"
"""Name of the port."""
_FRAMES = ("left_camera_optical", "right_camera_optical")
_CENTRELINE_SPACING = 0.001


@dataclasses.dataclass(frozen=True)
class Exposure:
    """The needle at one moment, as cameras see it.

    Attributes
    ----------
    number : int
        Of the exposure.
    stamp_ns : int
        When it was [ns].
    insertion : float
        Of the needle [m].
    T_rig_tip : ndarray, shape (4, 4)
        Pose of the tip [m].
    centreline : ndarray, shape (n, 3)
        From the entry to the tip, in `rig` [m].
    """

    number: int
    stamp_ns: int
    insertion: float
    T_rig_tip: NDArray[np.float64]
    centreline: NDArray[np.float64]

    @staticmethod
    def of(bench: SimulatedBench, number: int, stamp_ns: int) -> Exposure:
        """Return what cameras see of the bench now."""
        plant = bench.plant
        line = plant.centreline(_CENTRELINE_SPACING)
        return Exposure(number, stamp_ns, bench.insertion, plant.T_rig_tip, line)


class StereoCameras:
    """Two cameras that render what they see.

    Parameters
    ----------
    settings : SimRigParameters
        The rig's.
    """

    outputs = tuple(
        Output(f"stereo/{side}/{name}", kind, IMAGES)
        for side in ("left", "right")
        for name, kind in (("image_raw", m.Image), ("camera_info", m.CameraInfo))
    )

    def __init__(self, settings: SimRigParameters) -> None:
        file, rig = _load(settings)
        self.half_sizes = (rig.half_height, rig.half_width)
        self._cameras = (rig.left, rig.right)
        scenario = SCENARIOS[settings.scenario]
        self._has_needle = scenario.needle
        self._needle = settings.needle
        self._renderer = StereoRenderer(rig, settings.seed, self._needle, scenario)
        self._folder: ImageFolder | None = None
        if settings.images:
            self._folder = ImageFolder(Path(settings.images).expanduser(), file)

    def render(self, seen: Exposure) -> Iterable[Publish]:
        """Return the images of an exposure, each after its camera_info."""
        pose, line = seen.T_rig_tip, seen.centreline
        images = self._renderer.render(pose, line, seen.number)
        if self._folder is not None:
            self._folder.write(
                seen.number,
                images,
                seen.insertion,
                truth_of(pose, self._needle) if self._has_needle and len(line) > 1 else None,
                self._renderer.share_seen(pose, line, seen.number),
            )
        for side, image, frame, camera in zip(
            ("left", "right"), images, _FRAMES, self._cameras, strict=True
        ):
            info = camera_info_message(camera, frame, seen.stamp_ns)
            yield Publish(f"stereo/{side}/camera_info", info)
            yield Publish(f"stereo/{side}/image_raw", image_message(image, frame, seen.stamp_ns))

    def close(self) -> None:
        """End the folder's files."""
        if self._folder is not None:
            self._folder.close()


class CameraSensor:
    """Levels with cameras: a rendered stereo pair.

    Parameters
    ----------
    bench : SimulatedBench
        What is seen.
    settings : SimRigParameters
        The rig's.
    """

    ports: tuple[Port, ...] = ()

    def __init__(self, bench: SimulatedBench, settings: SimRigParameters) -> None:
        self._bench = bench
        self._cameras = StereoCameras(settings)
        self.half_sizes, self.outputs = self._cameras.half_sizes, self._cameras.outputs

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Return the images of an exposure."""
        return self._cameras.render(Exposure.of(self._bench, number, stamp_ns))

    def close(self) -> None:
        """Complete what the cameras write."""
        self._cameras.close()


class DistantCameras:
    """Cameras behind the port `cameras`: who renders there has the time for it.

    Parameters
    ----------
    bench : SimulatedBench
        What is seen.
    settings : SimRigParameters
        The rig's.
    """

    outputs: tuple[Output, ...] = ()
    ports: tuple[Port, ...] = ()

    def __init__(self, bench: SimulatedBench, settings: SimRigParameters) -> None:
        self._bench = bench
        _, rig = _load(settings)
        self.half_sizes = (rig.half_height, rig.half_width)

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Return the exposure itself."""
        yield Send(CAMERAS, (Exposure.of(self._bench, number, stamp_ns),))

    def close(self) -> None:
        """Do nothing: nothing is open."""


def _load(settings: SimRigParameters) -> tuple[Path, StereoRig]:
    """Return the calibration's file and what is in it."""
    own = settings.calibration_file
    file = Path(own) if own else find_shared("needle_tracker", "config/calibration.yaml")
    return file, load_stereo_rig(str(file))


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
