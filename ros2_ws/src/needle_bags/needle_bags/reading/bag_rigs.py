"""Finds the rigs in a bag by their topics."""

from __future__ import annotations

from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory

CALIBRATION = "stereo_tracker/calibration"
_LANDMARK = "needle/controller_status"
_TYPES = {
    "needle/tip": "geometry_msgs/msg/PointStamped",
    "needle/tip_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "sim/tip_pose": "geometry_msgs/msg/PoseStamped",
    "needle/estimate": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "needle/reduced_state": "geometry_msgs/msg/Vector3Stamped",
    "needle/control_input": "geometry_msgs/msg/Vector3Stamped",
    "joint_states": "sensor_msgs/msg/JointState",
    "device/hold": "sensor_msgs/msg/Joy",
    "device/joint_trajectory": "trajectory_msgs/msg/JointTrajectory",
    "device/result": "std_msgs/msg/Header",
    "needle/controller_status": "diagnostic_msgs/msg/DiagnosticStatus",
    "device/status": "diagnostic_msgs/msg/DiagnosticStatus",
    CALIBRATION: "std_msgs/msg/String",
}


def namespaces(contents: BagDirectory) -> list[str]:
    """Return the namespaces of the rigs in a bag; each ends with `/`."""
    return sorted(
        name.removesuffix(_LANDMARK) for name in contents.topics if name.endswith(f"/{_LANDMARK}")
    )


def namespace_of(contents: BagDirectory, wanted: str | None = None) -> str:
    """Return the namespace of the rig to read; it ends with `/`.

    Parameters
    ----------
    contents : BagDirectory
        The bag.
    wanted : str, optional
        Namespace given by the user; required if the bag holds several rigs.

    Raises
    ------
    UserError
        If the bag holds no rig, not the wanted one, or several and none is given.
    """
    found = namespaces(contents)
    if not found:
        raise UserError(
            f"{contents.path} contains no needle run: no topic {_LANDMARK} among its "
            f"{len(contents.topics)}; give a bag that the rig's recorder made"
        )
    listed = ", ".join(name.rstrip("/") or "/" for name in found)
    if wanted is not None:
        namespace = f"/{wanted.strip('/')}/".replace("//", "/")
        if namespace not in found:
            raise UserError(f"{contents.path} has no rig in {wanted}; it has rigs in {listed}")
        return namespace
    if len(found) > 1:
        raise UserError(
            f"{contents.path} holds {len(found)} rigs, in {listed}: choose one with --namespace"
        )
    return found[0]


def require_types(contents: BagDirectory, namespace: str) -> None:
    """Raise a `UserError` if a topic of the rig has a wrong type."""
    types = {namespace + name: type_name for name, type_name in _TYPES.items()}
    types["/diagnostics"] = "diagnostic_msgs/msg/DiagnosticArray"
    for name, wanted in types.items():
        topic = contents.topics.get(name)
        if topic is not None and topic.type_name != wanted:
            raise UserError(
                f"{contents.path}: {name} has type {topic.type_name}, the rig's has {wanted}: "
                "this bag is not of the rig's graph"
            )
