"""Bag of a made-up run with known figures, shared by the bag tests."""

from __future__ import annotations

import dataclasses
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
from needle_bags.format.bag_writer import BagCopy, BagWriter, standard_topic
from needle_bags.reading.bag_messages import SentMessage, raw_as_sent, read_contents

STORE = get_typestore(Stores.ROS2_JAZZY)
STEPS = 120
OFFSET = 3e-3
FINAL_R1 = -0.25e-3
TIP_ERROR = np.array([0.3e-3, 0.0, -0.4e-3])
START = 1_700_000_000_000_000_000
STEP_WALL_NS = 50_000_000


def message(type_name: str, **fields: Any) -> Any:
    return STORE.types[type_name](**fields)


def serialized(content: Any) -> bytes:
    return bytes(STORE.serialize_cdr(content, content.__msgtype__))


def header(nanoseconds: int, frame: str = "rig") -> Any:
    sec, nanosec = divmod(nanoseconds, 1_000_000_000)
    stamp = message("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def vector(values: Sequence[float] | np.ndarray, kind: str = "Vector3") -> Any:
    named = dict(zip("xyz", map(float, values), strict=True))
    return message(f"geometry_msgs/msg/{kind}", **named)


def pose(position: np.ndarray, beta: float) -> Any:
    half = {"x": 0.0, "y": float(np.sin(beta / 2)), "z": 0.0, "w": float(np.cos(beta / 2))}
    turn = message("geometry_msgs/msg/Quaternion", **half)
    return message("geometry_msgs/msg/Pose", position=vector(position, "Point"), orientation=turn)


def status(values: Mapping[str, object]) -> Any:
    kind = "diagnostic_msgs/msg/KeyValue"
    pairs = [message(kind, key=key, value=str(value)) for key, value in values.items()]
    texts = {"name": "n", "message": "m", "hardware_id": "h"}
    return message("diagnostic_msgs/msg/DiagnosticStatus", level=0, values=pairs, **texts)


def copy_messages(
    source: Path, copy: BagCopy, change: Callable[[SentMessage], bytes | None] = lambda m: m.data
) -> None:
    """Copy the messages of a bag; `change` returns their data, or None to leave one out."""
    topics = read_contents(source).topics
    for one in raw_as_sent(source, lambda _: True):
        data = change(one)
        if data is not None:
            copy.put(topics[one.topic], data, one.log_time, one.time)


class SyntheticBag:
    def __init__(self, directory: Path, namespace: str = "/") -> None:
        self.bag = BagWriter(directory)
        self.namespace = namespace
        self.channels: dict[str, str] = {}
        self.now = START

    def put(self, topic: str, content: Any, *, latched: bool = False) -> None:
        name, kind = self.namespace + topic, content.__msgtype__
        if name not in self.channels:
            durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
            qos = USUAL_QOS._replace(durability=durability)
            described = dataclasses.replace(standard_topic(name, kind), offered_qos=(qos,))
            self.channels[name] = self.bag.add_topic(described)
        self.bag.write(self.channels[name], serialized(content), self.now, self.now)


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
    """Write a needle that moves from r1 = -3 mm to FINAL_R1 on a cosine, with errors TIP_ERROR."""
    out = SyntheticBag(directory, namespace)
    info = {"level": "tip", "controller": "paper", "seed": 7}
    if command is not None:
        info["command"] = command
    parameters = {"/sim_rig": {"ros__parameters": {"level": "tip"}}}
    for key, text in {
        **{"run_info": json.dumps(info), "commit": "0123abc", "calibration": calibration},
        "versions": json.dumps({"python": "3.11"}),
        "parameters": yaml.safe_dump(parameters),
    }.items():
        out.bag.set_custom_data(key, text)
    for number in range(steps + 1):
        out.now += STEP_WALL_NS
        time = number * 520_000_000
        at, in_plane = {"header": header(time)}, {"header": header(time, "target_plane")}
        depth = number * 1e-3
        phase = min(number / STEPS, 1.0)
        r1 = FINAL_R1 + (-3e-3 - FINAL_R1) * (1 + np.cos(np.pi * phase)) / 2
        slope = -(-3e-3 - FINAL_R1) * np.pi / 2 * np.sin(np.pi * phase) / (STEPS * 1e-3)
        tip = np.array([OFFSET + r1, 1e-3 * phase, depth])
        if number:
            result = message("std_msgs/msg/Header", stamp=header(time).stamp, frame_id="succeeded")
            out.put("device/result", result)
        joints = {"name": ["insertion_joint", "rotation_joint"], "velocity": np.empty(0)}
        joints |= {"position": np.array([depth, 0.1 * number]), "effort": np.empty(0)}
        out.put("joint_states", message("sensor_msgs/msg/JointState", **at, **joints))
        if image_height is not None:
            shape = {"height": image_height, "width": 4, "step": 4, "is_bigendian": 0}
            shown = {**shape, "encoding": "mono8", "data": np.full(12, number, np.uint8)}
            for side in ("left", "right"):
                image = message("sensor_msgs/msg/Image", **at, **shown)
                out.put(f"stereo/{side}/image_raw", image)
        if truth:
            true = message("geometry_msgs/msg/PoseStamped", **at, pose=pose(tip, slope))
            out.put("sim/tip_pose", true)
        measured = vector(tip + (np.nan if number == bad_tip else TIP_ERROR), "Point")
        out.put("needle/tip", message("geometry_msgs/msg/PointStamped", **at, point=measured))
        kind, reduced = "geometry_msgs/msg/Vector3Stamped", vector([r1 + 1e-4, slope + 0.01, 0.02])
        out.put("needle/reduced_state", message(kind, **in_plane, vector=reduced))
        inputs = vector([2e-3, 100.0, 0.1 * number])
        out.put("needle/control_input", message(kind, **at, vector=inputs))
        controller = {
            **{"step": number, "insertion_m": depth, "target_offset_m": OFFSET},
            "state": "STEERING" if number < steps else "DONE" if done else "WAITING_FOR_TIP",
            "reason": "" if done or number < steps else "no tip for 2 s",
            **{"depth_m": STEPS * 1e-3, "watchdog_trips": 2},
        }
        out.put("needle/controller_status", status(controller), latched=True)
        device = {"state": "HOLDING", "watchdog_trips": 1}
        out.put("device/status", status(device), latched=True)
        kind = "trajectory_msgs/msg/JointTrajectory"
        out.put("device/joint_trajectory", message(kind, **at, joint_names=[], points=[]))
    out.bag.close()
    return directory


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes the made-up run into a bag, with `write_run`'s keywords."""

    def make(name: str = "run", **how: Any) -> Path:
        return write_run(tmp_path / name, **how)

    return make
