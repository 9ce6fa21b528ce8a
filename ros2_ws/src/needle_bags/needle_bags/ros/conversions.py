"""Conversion of quality of service between rclpy and bags."""

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
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

from needle_bags.reading.bag_messages import IMAGE_TYPES

# Assumed queue depths of latched topics, images and other topics: DDS does not announce the depth
# of a publisher.
UNKNOWN_LATCHED_DEPTH = 10
UNKNOWN_IMAGE_DEPTH = 30
UNKNOWN_DEPTH = 500


def offered_qos(offer: TopicEndpointInfo) -> Qos:
    """Return the offered QoS of a publisher."""
    qos = offer.qos_profile

    def time(duration: Duration) -> QosTime:
        return QosTime(*divmod(int(duration.nanoseconds), 10**9))

    return Qos(
        QosHistory[qos.history.name],
        int(qos.depth),
        QosReliability[qos.reliability.name],
        QosDurability[qos.durability.name],
        time(qos.deadline),
        time(qos.lifespan),
        QosLiveliness[qos.liveliness.name],
        time(qos.liveliness_lease_duration),
        False,
    )


def strictest_request(offers: Sequence[TopicEndpointInfo], depth: int) -> QoSProfile:
    """Return the strictest QoS that every publisher can serve."""
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


def recorded_offer(type_name: str, offers: Sequence[Qos]) -> QoSProfile:
    """Return an offer that matches every request that the recorded offers matched.

    A single recorded offer is kept; of several, the strongest value of each policy is used.
    """
    unknown_depth = UNKNOWN_IMAGE_DEPTH if type_name in IMAGE_TYPES else UNKNOWN_DEPTH
    if not offers:
        return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=unknown_depth)
    keep_all = any(offer.history == QosHistory.KEEP_ALL for offer in offers)
    reliable = any(offer.reliability != QosReliability.BEST_EFFORT for offer in offers)
    latched = any(offer.durability == QosDurability.TRANSIENT_LOCAL for offer in offers)
    if latched:
        unknown_depth = UNKNOWN_LATCHED_DEPTH
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if keep_all else HistoryPolicy.KEEP_LAST,
        depth=max(offer.depth for offer in offers) or unknown_depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        lifespan=_duration(max(offer.lifespan for offer in offers)),
        deadline=_duration(min(offer.deadline for offer in offers)),
    )


def _duration(time: QosTime) -> Duration:
    return Duration(seconds=time.sec, nanoseconds=time.nsec)
