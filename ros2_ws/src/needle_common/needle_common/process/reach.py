"""Reach of a node: the processes of this machine, unless the user asks for a network."""

from __future__ import annotations

import os
from collections.abc import Mapping, MutableMapping
from pathlib import Path

DISCOVERY_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
THIS_MACHINE = Path(__file__).with_name("needle_fastdds.xml")
NETWORK = Path(__file__).with_name("needle_fastdds_network.xml")
THIS_MACHINE_UDP = Path(__file__).with_name("needle_fastdds_udp.xml")
NETWORK_UDP = Path(__file__).with_name("needle_fastdds_network_udp.xml")
# How long a device on another machine has to show itself before anything begins here [s].
DISCOVERY = 2.0

_CLOSED = ("LOCALHOST", "OFF")
_OURS = [file.name for file in (THIS_MACHINE, NETWORK, THIS_MACHINE_UDP, NETWORK_UDP)]


def keep_to_this_machine(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set what is not set, so that a node started from here reaches this machine only.

    Where the user's discovery range asks for a network, the node is open to it. A file of profiles
    of the user's own stays; one that is not there would leave everything open, and does not.

    Parameters
    ----------
    environment : mutable mapping
        Read by ROS and Fast DDS when the first node is made.
    """
    given = Path(environment.get(PROFILES) or THIS_MACHINE)
    if given.name == THIS_MACHINE_UDP.name:
        # Of a process that has left shared memory, and has started this one.
        environment[DISCOVERY_RANGE] = _CLOSED[0]
    environment.setdefault(DISCOVERY_RANGE, _CLOSED[0])
    if given.name in _OURS or not given.is_file():
        environment[PROFILES] = str(NETWORK if is_open(environment) else THIS_MACHINE)


def leave_shared_memory(environment: MutableMapping[str, str] = os.environ) -> None:
    """Keep a node's messages out of shared memory, whose opening may hold a process up for 0.33 s.

    For who must not be held up and has no images; reached as `keep_to_this_machine` has set it.

    Parameters
    ----------
    environment : mutable mapping
        Read by ROS and Fast DDS when the first node is made.
    """
    profiles = environment[PROFILES]
    if profiles == str(NETWORK):
        environment[PROFILES] = str(NETWORK_UDP)
    elif profiles == str(THIS_MACHINE) and environment[DISCOVERY_RANGE].upper() == _CLOSED[0]:
        environment[PROFILES] = str(THIS_MACHINE_UDP)
        # For LOCALHOST rmw_fastrtps adds shared memory; the profiles keep to it by themselves.
        environment[DISCOVERY_RANGE] = "SYSTEM_DEFAULT"


def is_open(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether the user has asked for a network."""
    if environment.get(PROFILES) == str(THIS_MACHINE_UDP):
        return False
    return environment.get(DISCOVERY_RANGE, _CLOSED[0]).upper() not in _CLOSED
