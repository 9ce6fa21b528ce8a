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

_LOCALHOST = "LOCALHOST"
_OURS = [file.name for file in (THIS_MACHINE, NETWORK, THIS_MACHINE_UDP, NETWORK_UDP)]


def keep_to_this_machine(
    environment: MutableMapping[str, str] = os.environ, *, shared_memory: bool = True
) -> None:
    """Set what is not set, so that a node started from here reaches this machine only.

    Where the user's discovery range asks for a network, the node is open to it. A file of profiles
    of the user's own stays; one that is not there would leave everything open, and does not.

    Parameters
    ----------
    environment : mutable mapping
        Read by ROS and Fast DDS when the first node is made.
    shared_memory : bool
        Whether messages may go through shared memory, if the profiles are ours: opening that of a
        process which appears may hold this one up for 0.33 s.
    """
    given = Path(environment.get(PROFILES) or THIS_MACHINE)
    if given.name == THIS_MACHINE_UDP.name:
        # Of a process without shared memory that has started this one.
        environment[DISCOVERY_RANGE] = _LOCALHOST
    reach = environment.setdefault(DISCOVERY_RANGE, _LOCALHOST).upper()
    if given.name not in _OURS and given.is_file():
        return
    if is_open(environment):
        environment[PROFILES] = str(NETWORK if shared_memory else NETWORK_UDP)
    elif shared_memory or reach != _LOCALHOST:
        environment[PROFILES] = str(THIS_MACHINE)
    else:
        environment[PROFILES] = str(THIS_MACHINE_UDP)
        # For LOCALHOST rmw_fastrtps adds shared memory; these profiles keep to it by themselves.
        environment[DISCOVERY_RANGE] = "SYSTEM_DEFAULT"


def is_open(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether the user has asked for a network."""
    if environment.get(PROFILES) == str(THIS_MACHINE_UDP):
        return False
    return environment.get(DISCOVERY_RANGE, _LOCALHOST).upper() not in (_LOCALHOST, "OFF")
