"""Cameras of the simulated rig: a rendered stereo pair per exposure, in this process or another."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from needle_core import messages as m
from needle_core.commands.cli import EXIT_MISSED
from needle_core.component import (
    IMAGES,
    Actions,
    Exit,
    Moment,
    Output,
    Port,
    PortChange,
    Publish,
    Send,
)
from needle_core.files.installed import find_shared_file
from needle_sim.bench import SimulatedBench
from needle_sim.camera.image_folder import ImageFolder, RenderedPair, truth_of
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import SCENARIOS
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig, load_stereo_rig
from needle_sim.sim_rig_parameters import SimRigParameters

CAMERAS = "cameras"
"""Name of the port through which exposures are sent to another process."""
_FRAMES = ("left_camera_optical", "right_camera_optical")
_CENTRELINE_SPACING = 0.001  # [m]
_MAX_PENDING_EXPOSURES = 2


@dataclasses.dataclass(frozen=True)
class Exposure:
    """State of the needle at the time of an exposure.

    Attributes
    ----------
    number : int
        Number of the exposure.
    stamp_ns : int
        Time of the exposure [ns].
    insertion : float
        Insertion of the needle [m].
    T_rig_tip : ndarray, shape (4, 4)
        Pose of the tip [m].
    centreline : ndarray, shape (n, 3)
        Path from the entry point to the tip, in `rig` [m].
    """

    number: int
    stamp_ns: int
    insertion: float
    T_rig_tip: NDArray[np.float64]
    centreline: NDArray[np.float64]

    @staticmethod
    def of(bench: SimulatedBench, number: int, stamp_ns: int) -> Exposure:
        """Return the present state of the bench as an exposure."""
        plant = bench.plant
        line = plant.centreline(_CENTRELINE_SPACING)
        return Exposure(number, stamp_ns, bench.insertion, plant.T_rig_tip, line)


class StereoCameras:
    """Two cameras that render exposures, and write them into a folder if the settings name one.

    Parameters
    ----------
    settings : SimRigParameters
        Parameters of the rig.
    """

    outputs = tuple(
        Output(f"stereo/{side}/{name}", kind, IMAGES)
        for side in ("left", "right")
        for name, kind in (("image_raw", m.Image), ("camera_info", m.CameraInfo))
    )

    def __init__(self, settings: SimRigParameters) -> None:
        file, rig = _load_calibration(settings)
        self.half_sizes = (rig.half_height, rig.half_width)
        self._cameras = (rig.left, rig.right)
        scenario = SCENARIOS[settings.scenario]
        self._has_needle = scenario.needle
        self._needle = settings.needle
        self._renderer = StereoRenderer(rig, settings.seed, self._needle, scenario)
        self._folder: ImageFolder | None = None
        if settings.images:
            self._folder = ImageFolder(Path(settings.images).expanduser(), file)

    def render(self, exposure: Exposure) -> list[Publish]:
        """Return the two images of an exposure, each after its camera_info."""
        pose, line, number = exposure.T_rig_tip, exposure.centreline, exposure.number
        images = self._renderer.render(pose, line, number)
        if self._folder is not None:
            has_needle = self._has_needle and len(line) > 1
            truth = truth_of(pose, self._needle) if has_needle else None
            visible = self._renderer.visible_share(pose, line, number)
            self._folder.write(RenderedPair(number, images, exposure.insertion, truth, visible))
        messages, stamp_ns = [], exposure.stamp_ns
        for side, image, frame, camera in zip(
            ("left", "right"), images, _FRAMES, self._cameras, strict=True
        ):
            info = camera_info_message(camera, frame, stamp_ns)
            messages.append(Publish(f"stereo/{side}/camera_info", info))
            pixels = image_message(image, frame, stamp_ns)
            messages.append(Publish(f"stereo/{side}/image_raw", pixels))
        return messages


class CameraSensor(StereoCameras):
    """Sensor of the levels with cameras: renders in this process.

    Parameters
    ----------
    bench : SimulatedBench
        Needle in front of the cameras.
    settings : SimRigParameters
        Parameters of the rig.
    """

    ports: tuple[Port, ...] = ()

    def __init__(self, bench: SimulatedBench, settings: SimRigParameters) -> None:
        super().__init__(settings)
        self._bench = bench

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Return the images of an exposure."""
        return self.render(Exposure.of(self._bench, number, stamp_ns))


class RemoteCameras:
    """Cameras behind the port `cameras`: another process renders the exposures.

    Parameters
    ----------
    bench, settings
        As for `CameraSensor`.
    """

    outputs: tuple[Output, ...] = ()
    ports: tuple[Port, ...] = ()

    def __init__(self, bench: SimulatedBench, settings: SimRigParameters) -> None:
        self._bench = bench
        _, rig = _load_calibration(settings)
        self.half_sizes = (rig.half_height, rig.half_width)

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Send the exposure through the port."""
        yield Send(CAMERAS, (Exposure.of(self._bench, number, stamp_ns),))


class PublishedRemoteCameras(RemoteCameras):
    """Remote cameras whose images return through the port and are published here.

    Exposures are dropped while too many wait to be rendered, like the lost frames of a camera.
    """

    outputs = StereoCameras.outputs

    def __init__(self, bench: SimulatedBench, settings: SimRigParameters) -> None:
        super().__init__(bench, settings)
        self._pending = 0
        self.ports = (Port(CAMERAS, self._on_images, self._on_change),)

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Send the exposure through the port, unless too many are pending."""
        if self._pending < _MAX_PENDING_EXPOSURES:
            self._pending += 1
            yield from super().expose(number, stamp_ns)

    def _on_images(self, batch: Sequence[Sequence[Publish]], at: Moment) -> Actions:
        for images in batch:
            self._pending -= 1
            yield from images

    def _on_change(self, change: PortChange, at: Moment) -> Actions:
        yield Exit(EXIT_MISSED, change.lost)


def make_renderer(settings: SimRigParameters) -> Callable[[Exposure], list[Publish]]:
    """Return the function that renders exposures in another process."""
    return StereoCameras(settings).render


def _load_calibration(settings: SimRigParameters) -> tuple[Path, StereoRig]:
    """Return the calibration file and its content."""
    name = settings.calibration_file
    file = Path(name) if name else find_shared_file("needle_tracker", "config/calibration.yaml")
    return file, load_stereo_rig(str(file))


def image_message(pixels: NDArray[np.uint8], frame: str, stamp_ns: int) -> m.Image:
    """Return a grey image as a message."""
    height, width = pixels.shape
    return m.Image(stamp_ns, frame, height, width, "mono8", width, pixels.tobytes())


def camera_info_message(camera: SimulatedCamera, frame: str, stamp_ns: int) -> m.CameraInfo:
    """Return the calibration of a camera as a message; the images are not rectified."""
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
