"""Shared by the bag tests: the bag of a made-up run whose figures are known."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.interfaces import QosDurability
from rosbags.typesys import Stores, get_typestore

from needle_bags.format.bag_metadata import USUAL_QOS
from needle_bags.format.bag_writer import BagWriter
from needle_core.files.bag_topic import BagTopic

STORE = get_typestore(Stores.ROS2_JAZZY)
STEPS = 120
OFFSET = 3e-3
FINAL_R1 = -0.25e-3
TIP_ERROR = np.array([0.3e-3, 0.0, -0.4e-3])
START = 1_700_000_000_000_000_000
STEP_WALL_NS = 50_000_000


def message(type_name: str, **fields: Any) -> Any:
    return STORE.types[type_name](**fields)


def stamp(nanoseconds: int) -> Any:
    sec, nanosec = divmod(nanoseconds, 1_000_000_000)
    return message("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def header(nanoseconds: int, frame: str = "rig") -> Any:
    return message("std_msgs/msg/Header", stamp=stamp(nanoseconds), frame_id=frame)


def vector(values: Sequence[float] | np.ndarray, kind: str = "Vector3") -> Any:
    x, y, z = (float(value) for value in values)
    return message(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def pose(position: np.ndarray, beta: float) -> Any:
    orientation = message(
        "geometry_msgs/msg/Quaternion",
        x=0.0,
        y=float(np.sin(beta / 2)),
        z=0.0,
        w=float(np.cos(beta / 2)),
    )
    return message(
        "geometry_msgs/msg/Pose", position=vector(position, "Point"), orientation=orientation
    )


def status(values: Mapping[str, object]) -> Any:
    pairs = [
        message("diagnostic_msgs/msg/KeyValue", key=k, value=str(v)) for k, v in values.items()
    ]
    return message(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=0,
        name="n",
        message="m",
        hardware_id="h",
        values=pairs,
    )


class SyntheticBag:
    def __init__(self, directory: Path, namespace: str = "/") -> None:
        self.bag = BagWriter(directory)
        self.namespace = namespace
        self.channels: dict[str, int] = {}
        self.now = START

    def put(self, topic: str, type_name: str, content: Any, *, latched: bool = False) -> None:
        name = topic if topic.startswith("/") else self.namespace + topic
        if name not in self.channels:
            durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
            self.channels[name] = self.bag.add_topic(
                BagTopic(
                    name,
                    type_name,
                    STORE.generate_msgdef(type_name, ros_version=2)[0],
                    STORE.hash_rihs01(type_name),
                    (USUAL_QOS._replace(durability=durability),),
                )
            )
        data = bytes(STORE.serialize_cdr(content, type_name))
        self.bag.write(self.channels[name], data, self.now, self.now)


def write_run(
    directory: Path,
    *,
    steps: int = STEPS,
    truth: bool = True,
    done: bool = True,
    calibration: str = "",
    namespace: str = "/",
    bad_tip: int | None = None,
    image_height: int | None = None,
    command: str | None = None,
) -> Path:
    """A needle that goes from r1 = -3 mm to FINAL_R1 on a cosine, measured TIP_ERROR off."""
    out = SyntheticBag(directory, namespace)
    info = {"level": "tip", "controller": "paper", "seed": 7}
    if command is not None:
        info["command"] = command
    out.bag.set_custom_data("run_info", json.dumps(info))
    out.bag.set_custom_data("commit", "0123abc")
    out.bag.set_custom_data("versions", json.dumps({"python": "3.11"}))
    out.bag.set_custom_data("calibration", calibration)
    out.bag.set_custom_data(
        "parameters", yaml.safe_dump({"/sim_rig": {"ros__parameters": {"level": "tip"}}})
    )
    for number in range(steps + 1):
        out.now += STEP_WALL_NS
        time = number * 520_000_000
        depth = number * 1e-3
        phase = min(number / STEPS, 1.0)
        r1 = FINAL_R1 + (-3e-3 - FINAL_R1) * (1 + np.cos(np.pi * phase)) / 2
        slope = -(-3e-3 - FINAL_R1) * np.pi / 2 * np.sin(np.pi * phase) / (STEPS * 1e-3)
        tip = np.array([OFFSET + r1, 1e-3 * phase, depth])
        controller = {
            "state": "STEERING" if number < steps else "DONE" if done else "WAITING_FOR_TIP",
            "step": number,
            "insertion_m": depth,
            "target_offset_m": OFFSET,
            "depth_m": STEPS * 1e-3,
            "reason": "" if done or number < steps else "no tip for 2 s",
            "watchdog_trips": 2,
        }
        if number:
            result = message("std_msgs/msg/Header", stamp=stamp(time), frame_id="succeeded")
            out.put("device/result", "std_msgs/msg/Header", result)
        joints = message(
            "sensor_msgs/msg/JointState",
            header=header(time),
            name=["insertion_joint", "rotation_joint"],
            position=np.array([depth, 0.1 * number]),
            velocity=np.empty(0),
            effort=np.empty(0),
        )
        out.put("joint_states", "sensor_msgs/msg/JointState", joints)
        if image_height is not None:
            for side in ("left", "right"):
                image = message(
                    "sensor_msgs/msg/Image",
                    header=header(time),
                    height=image_height,
                    width=4,
                    encoding="mono8",
                    is_bigendian=0,
                    step=4,
                    data=np.full(12, number, np.uint8),
                )
                out.put(f"stereo/{side}/image_raw", "sensor_msgs/msg/Image", image)
        if truth:
            content = message(
                "geometry_msgs/msg/PoseStamped", header=header(time), pose=pose(tip, slope)
            )
            out.put("sim/tip_pose", "geometry_msgs/msg/PoseStamped", content)
        point = message(
            "geometry_msgs/msg/PointStamped",
            header=header(time),
            point=vector(tip + (np.nan if number == bad_tip else TIP_ERROR), "Point"),
        )
        out.put("needle/tip", "geometry_msgs/msg/PointStamped", point)
        reduced = message(
            "geometry_msgs/msg/Vector3Stamped",
            header=header(time, "target_plane"),
            vector=vector([r1 + 1e-4, slope + 0.01, 0.02]),
        )
        out.put("needle/reduced_state", "geometry_msgs/msg/Vector3Stamped", reduced)
        control = message(
            "geometry_msgs/msg/Vector3Stamped",
            header=header(time),
            vector=vector([2e-3, 100.0, 0.1 * number]),
        )
        out.put("needle/control_input", "geometry_msgs/msg/Vector3Stamped", control)
        out.put(
            "needle/controller_status",
            "diagnostic_msgs/msg/DiagnosticStatus",
            status(controller),
            latched=True,
        )
        device = {"state": "HOLDING", "watchdog_trips": 1}
        out.put(
            "device/status", "diagnostic_msgs/msg/DiagnosticStatus", status(device), latched=True
        )
        command = message(
            "trajectory_msgs/msg/JointTrajectory", header=header(time), joint_names=[], points=[]
        )
        out.put("device/joint_trajectory", "trajectory_msgs/msg/JointTrajectory", command)
    out.bag.close()
    return directory


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Writes the made-up run into a bag; takes `write_run`'s keywords."""

    def make(name: str = "run", **how: Any) -> Path:
        return write_run(tmp_path / name, **how)

    return make
