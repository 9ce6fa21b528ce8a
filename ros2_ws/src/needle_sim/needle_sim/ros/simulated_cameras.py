"""Exposures of sim_rig at the levels with cameras: images of the needle."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image

from needle_core.ros.conversions import IMAGES, RELIABLE
from needle_sim.camera.image_folder import ImageFolder, truth_of
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import SCENARIOS
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.rig.bench import SimulatedBench
from needle_sim.ros.conversions import to_camera_info, to_image
from needle_sim.sim_rig_parameters import SimRigParameters

_FRAMES = ("left_camera_optical", "right_camera_optical")
_CENTRELINE_SPACING = 0.001


class SimulatedCameras:
    """Publishes rendered image pairs, and writes them into a folder where that is wanted.

    Parameters
    ----------
    node : Node
        Gets publishers and subscription.
    bench : SimulatedBench
        What is seen.
    values : SimRigParameters
        The node's.
    on_answer : callable
        Called with what the tracker says of each pair.

    Attributes
    ----------
    publishers, heard : list of Publisher
        All of its publishers, and those that partners must listen to.
    subscriptions : list of Subscription
        Topics that partners must publish.
    """

    def __init__(
        self,
        node: Node,
        bench: SimulatedBench,
        values: SimRigParameters,
        on_answer: Callable[[PoseWithCovarianceStamped], None],
    ) -> None:
        self._bench = bench
        file = values.calibration_file or str(
            Path(get_package_share_directory("needle_tracker")) / "config" / "calibration.yaml"
        )
        rig = load_stereo_rig(file)
        self.half_sizes = (rig.half_height, rig.half_width)
        self._cameras = (rig.left, rig.right)
        scenario = SCENARIOS[values.scenario]
        self._has_needle = scenario.needle
        self._needle = values.needle
        self._renderer = StereoRenderer(rig, values.seed, self._needle, scenario)
        self._folder: ImageFolder | None = None
        if values.images:
            self._folder = ImageFolder(Path(values.images).expanduser(), Path(file))
        self._views = [
            (
                node.create_publisher(Image, f"stereo/{side}/image_raw", IMAGES),
                node.create_publisher(CameraInfo, f"stereo/{side}/camera_info", IMAGES),
            )
            for side in ("left", "right")
        ]
        self.publishers: list[Publisher[Any]] = [one for view in self._views for one in view]
        self.heard: list[Publisher[Any]] = [image_raw for image_raw, _ in self._views]
        answers = node.create_subscription(
            PoseWithCovarianceStamped, "needle/tip_pose", on_answer, RELIABLE
        )
        self.subscriptions: list[Subscription[Any]] = [answers]

    def expose(self, number: int, stamp: Time) -> None:
        """Publish the images of an exposure."""
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
        for image, frame, camera, (image_raw, camera_info) in zip(
            images, _FRAMES, self._cameras, self._views, strict=True
        ):
            camera_info.publish(to_camera_info(camera, frame, stamp))
            image_raw.publish(to_image(image, frame, stamp))

    def close(self) -> None:
        """End the folder's files."""
        if self._folder is not None:
            self._folder.close()
