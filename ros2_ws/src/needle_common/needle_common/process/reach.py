"""Reach of a node: the processes of this machine, unless the user asks for a network."""

from __future__ import annotations

import os
from collections.abc import Mapping, MutableMapping
from pathlib import Path

DISCOVERY_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
THIS_MACHINE = Path(__file__).with_name("needle_fastdds.xml")
NETWORK = Path(__file__).with_name("needle_fastdds_network.xml")
# How long a device on another machine has to show itself before anything begins here [s].
DISCOVERY = 2.0

_CLOSED = ("LOCALHOST", "OFF")


def keep_to_this_machine(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set what is not set, so that a node started from here reaches this machine only.

    Where the user's discovery range asks for a network, the node is open to it. A file of profiles
    of the user's own stays; one that is not there would leave everything open, and does not.

    Parameters
    ----------
    environment : mutable mapping
        Read by ROS and Fast DDS when the first node is made.
    """
    environment.setdefault(DISCOVERY_RANGE, "LOCALHOST")
    given = Path(environment.get(PROFILES) or THIS_MACHINE)
    if given.name in (THIS_MACHINE.name, NETWORK.name) or not given.is_file():
        environment[PROFILES] = str(NETWORK if is_open(environment) else THIS_MACHINE)


def is_open(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether the user has asked for a network."""
    return environment.get(DISCOVERY_RANGE, _CLOSED[0]).upper() not in _CLOSED
