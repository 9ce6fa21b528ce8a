"""Rows of the conversion table for images and for markers, paths and frames of viewers."""

from __future__ import annotations

from typing import Any

import numpy as np

from needle_core import messages as m
from needle_core.message_types import MessageTypes, Row, floats, head, to_nanoseconds, xyz, xyzw

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def _path_fields(message: m.Path, t: MessageTypes) -> dict[str, Any]:
    header, make = t.header_of(message), t.make("geometry_msgs/msg/PoseStamped")
    poses = [make(header=header, pose=t.pose(at, _UPRIGHT)) for at in message.positions]
    return {"header": header, "poses": poses}


def _poses_fields(message: m.Poses, t: MessageTypes) -> dict[str, Any]:
    return {"header": t.header_of(message), "poses": [t.pose(*pose) for pose in message.poses]}


def _poses(r: Any) -> m.Poses:
    pairs = ((xyz(pose.position), xyzw(pose.orientation)) for pose in r.poses)
    return m.Poses(*head(r), tuple(pairs))


def _transform_fields(message: m.Transform, t: MessageTypes) -> dict[str, Any]:
    transform = t.make("geometry_msgs/msg/Transform")(
        translation=t.vector(message.translation), rotation=t.quaternion(message.rotation)
    )
    return {
        "header": t.header_of(message),
        "child_frame_id": message.child_frame_id,
        "transform": transform,
    }


def _transforms_fields(message: m.Transforms, t: MessageTypes) -> dict[str, Any]:
    make = t.make("geometry_msgs/msg/TransformStamped")
    return {"transforms": [make(**_transform_fields(one, t)) for one in message.transforms]}


def _transform(message: Any) -> m.Transform:
    return m.Transform(
        *head(message),
        message.child_frame_id,
        xyz(message.transform.translation),
        xyzw(message.transform.rotation),
    )


def _image_fields(message: m.Image, t: MessageTypes) -> dict[str, Any]:
    return {
        "header": t.header_of(message),
        "height": message.height,
        "width": message.width,
        "encoding": message.encoding,
        "is_bigendian": 0,
        "step": message.step,
        "data": t.octets(message.data),
    }


def _image(message: Any) -> m.Image:
    return m.Image(
        *head(message),
        int(message.height),
        int(message.width),
        message.encoding,
        int(message.step),
        # Avoid a copy: images are large and arrive at 60 Hz.
        memoryview(message.data),
    )


def _camera_info_fields(message: m.CameraInfo, t: MessageTypes) -> dict[str, Any]:
    roi = message.roi
    return {
        "header": t.header_of(message),
        "height": message.height,
        "width": message.width,
        "distortion_model": message.distortion_model,
        **{name: t.array(np.float64, getattr(message, name)) for name in "dkrp"},
        "binning_x": message.binning_x,
        "binning_y": message.binning_y,
        "roi": t.make("sensor_msgs/msg/RegionOfInterest")(
            x_offset=roi.x_offset,
            y_offset=roi.y_offset,
            height=roi.height,
            width=roi.width,
            do_rectify=False,
        ),
    }


def _camera_info(message: Any) -> m.CameraInfo:
    roi = message.roi
    return m.CameraInfo(
        *head(message),
        int(message.height),
        int(message.width),
        message.distortion_model,
        floats(message.d),
        floats(message.k),
        floats(message.r),
        floats(message.p),
        int(message.binning_x),
        int(message.binning_y),
        m.RegionOfInterest(*(int(v) for v in (roi.x_offset, roi.y_offset, roi.width, roi.height))),
    )


def _marker(message: Any) -> m.Marker:
    colour = message.color
    return m.Marker(
        message.header.frame_id,
        message.ns,
        int(message.id),
        int(message.type),
        int(message.action),
        xyz(message.pose.position),
        xyzw(message.pose.orientation),
        xyz(message.scale),
        to_nanoseconds(message.header.stamp),
        (float(colour.r), float(colour.g), float(colour.b), float(colour.a)),
        tuple(map(xyz, message.points)),
    )


def _ros_marker(marker: m.Marker, t: MessageTypes) -> Any:
    color = t.make("std_msgs/msg/ColorRGBA")(**dict(zip("rgba", marker.colour, strict=True)))
    image = t.make("sensor_msgs/msg/CompressedImage")
    return t.make("visualization_msgs/msg/Marker")(
        header=t.header_of(marker),
        ns=marker.namespace,
        id=marker.number,
        type=marker.kind,
        action=marker.action,
        pose=t.pose(marker.position, marker.orientation),
        scale=t.vector(marker.scale),
        color=color,
        lifetime=t.duration(0.0),
        frame_locked=False,
        points=[t.point(at) for at in marker.points],
        colors=[],
        texture_resource="",
        texture=image(header=t.header(0), format="", data=t.array(np.uint8, ())),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=t.make("visualization_msgs/msg/MeshFile")(
            filename="", data=t.array(np.uint8, ())
        ),
        mesh_use_embedded_materials=False,
    )


VIEW_ROWS: dict[type[Any], Row] = {
    m.Path: Row(
        "nav_msgs/msg/Path",
        _path_fields,
        lambda r: m.Path(*head(r), tuple(xyz(pose.pose.position) for pose in r.poses)),
    ),
    m.Transform: Row("geometry_msgs/msg/TransformStamped", _transform_fields, _transform),
    m.Poses: Row("geometry_msgs/msg/PoseArray", _poses_fields, _poses),
    m.Transforms: Row(
        "tf2_msgs/msg/TFMessage",
        _transforms_fields,
        lambda r: m.Transforms(tuple(map(_transform, r.transforms))),
    ),
    m.Image: Row("sensor_msgs/msg/Image", _image_fields, _image),
    m.CompressedImage: Row(
        "sensor_msgs/msg/CompressedImage",
        lambda message, t: {
            "header": t.header_of(message),
            "format": message.format,
            "data": t.octets(message.data),
        },
        lambda r: m.CompressedImage(*head(r), r.format, bytes(r.data)),
    ),
    m.CameraInfo: Row("sensor_msgs/msg/CameraInfo", _camera_info_fields, _camera_info),
    m.Markers: Row(
        "visualization_msgs/msg/MarkerArray",
        lambda message, t: {"markers": [_ros_marker(marker, t) for marker in message.markers]},
        lambda r: m.Markers(tuple(_marker(marker) for marker in r.markers)),
    ),
}
"""Message class to its row."""
