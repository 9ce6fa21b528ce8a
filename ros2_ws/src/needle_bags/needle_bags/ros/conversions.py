"""Quality of service between rclpy and what bags say."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo

from needle_bags.format.bag_metadata import OfferedQos

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
# DDS does not tell a publisher's depth. What late joiners get of a latched topic; and what a
# subscriber that is busy for a moment may have waiting.
UNKNOWN_LATCHED_DEPTH = 10
UNKNOWN_IMAGE_DEPTH = 30
UNKNOWN_DEPTH = 500


def offered_qos(offer: TopicEndpointInfo) -> OfferedQos:
    """Return what a publisher of the graph offers."""
    qos = offer.qos_profile

    def nanoseconds(duration: Duration) -> int:
        return int(duration.nanoseconds)

    return OfferedQos(
        history=qos.history.name.lower(),
        depth=int(qos.depth),
        reliability=qos.reliability.name.lower(),
        durability=qos.durability.name.lower(),
        deadline=nanoseconds(qos.deadline),
        lifespan=nanoseconds(qos.lifespan),
        liveliness=qos.liveliness.name.lower(),
        lease_duration=nanoseconds(qos.liveliness_lease_duration),
    )


def strictest_request(offers: Sequence[TopicEndpointInfo], depth: int) -> QoSProfile:
    """Return the strictest subscription that every publisher can serve."""
    profiles = [offer.qos_profile for offer in offers]
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    latched = bool(profiles) and all(
        p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles
    )
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def recorded_offer(type_name: str, offers: Sequence[OfferedQos]) -> QoSProfile:
    """Return the offer that serves whoever was served by the recorded ones.

    One recorded offer is given as it was. Of several, the stronger of each policy: it matches
    every request that one of them matched.
    """
    unknown_depth = UNKNOWN_IMAGE_DEPTH if type_name in IMAGE_TYPES else UNKNOWN_DEPTH
    if not offers:
        return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=unknown_depth)
    keep_all = any(offer.history == "keep_all" for offer in offers)
    reliable = any(offer.reliability != "best_effort" for offer in offers)
    latched = any(offer.durability == "transient_local" for offer in offers)
    if latched:
        unknown_depth = UNKNOWN_LATCHED_DEPTH
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if keep_all else HistoryPolicy.KEEP_LAST,
        depth=max(offer.depth for offer in offers) or unknown_depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        lifespan=Duration(nanoseconds=max(offer.lifespan for offer in offers)),
        deadline=Duration(nanoseconds=min(offer.deadline for offer in offers)),
    )
