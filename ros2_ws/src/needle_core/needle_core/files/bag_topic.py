"""A topic of a bag, and its publishers' quality of service."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from rosbags.interfaces import Qos, QosDurability, QosTime
from rosbags.rosbag2.metadata import parse_qos

from needle_core.files.plain_yaml import load_plain


def offered_profiles(profiles: Sequence[Mapping[str, Any]] | str) -> tuple[Qos, ...]:
    """Return the profiles that metadata.yaml or an MCAP channel has; none if it has other things.

    Parameters
    ----------
    profiles : sequence of mapping or str
        As they are from version 9 on, or as YAML text.
    """
    try:
        found: Any = load_plain(profiles) or [] if isinstance(profiles, str) else profiles
        return tuple(
            qos._replace(
                depth=int(qos.depth),
                deadline=QosTime(*map(int, qos.deadline)),
                lifespan=QosTime(*map(int, qos.lifespan)),
                liveliness_lease_duration=QosTime(*map(int, qos.liveliness_lease_duration)),
            )
            for qos in parse_qos(found)
        )
    except (ValueError, TypeError, KeyError, AttributeError):
        return ()


@dataclasses.dataclass(frozen=True)
class BagTopic:
    """A topic of a bag, beside its messages.

    Attributes
    ----------
    name : str
        Absolute name.
    type_name : str
        `package/msg/Name`.
    definition : str
        Full definition text; empty if the data do not define the type.
    type_hash : str
        `RIHS01_...` as the publishers announce it, or an empty text.
    offered_qos : tuple of Qos
        One for each publisher.
    encoding : str
        The definition's: `ros2msg` or `ros2idl`.
    """

    name: str
    type_name: str
    definition: str
    type_hash: str = ""
    offered_qos: tuple[Qos, ...] = ()
    encoding: str = "ros2msg"

    @property
    def is_latched(self) -> bool:
        """Tell whether late joiners get a publisher's last messages."""
        return any(qos.durability == QosDurability.TRANSIENT_LOCAL for qos in self.offered_qos)
