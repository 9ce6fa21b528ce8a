"""Discovery range of a node: this machine, unless the user asks for a network."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping, MutableMapping
from pathlib import Path

from needle_core.errors import UserError

DISCOVERY_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
THIS_MACHINE = Path(__file__).with_name("needle_fastdds.xml")
NETWORK = Path(__file__).with_name("needle_fastdds_network.xml")
THIS_MACHINE_UDP = Path(__file__).with_name("needle_fastdds_udp.xml")
NETWORK_UDP = Path(__file__).with_name("needle_fastdds_network_udp.xml")
# Time allowed to discover a device on another machine before the start [s].
DISCOVERY = 2.0

_LOCALHOST, _OFF = "LOCALHOST", "OFF"
_RANGES = (_LOCALHOST, "SUBNET", "SYSTEM_DEFAULT", _OFF)
_OURS = [file.name for file in (THIS_MACHINE, NETWORK, THIS_MACHINE_UDP, NETWORK_UDP)]
_LAST_DOMAIN = 232  # limited by the range of port numbers
_RMW, _FAST_DDS = "RMW_IMPLEMENTATION", "rmw_fastrtps_cpp"


def use_fast_dds(environment: MutableMapping[str, str] = os.environ) -> None:
    """Select Fast DDS, with a warning if another one was set; call this before loading ROS."""
    given = environment.get(_RMW) or _FAST_DDS
    if given != _FAST_DDS:
        print(f"{_RMW}={given} ignored: the rig's nodes run on {_FAST_DDS}", file=sys.stderr)
        environment[_RMW] = _FAST_DDS


def clean_environment(
    environment: MutableMapping[str, str] = os.environ, *, own_graph: bool = False
) -> None:
    """Print warnings for environment variables that change discovery, and remove invalid ones.

    Parameters
    ----------
    environment : mutable mapping
        Environment that ROS and Fast DDS read when the first node is created.
    own_graph : bool
        Whether this process starts all nodes, in their own domain.

    Raises
    ------
    UserError
        If the domain or discovery range does not exist, or variables contradict each other.
    """
    use_fast_dds(environment)
    reach = environment.get(DISCOVERY_RANGE) or _LOCALHOST
    if reach not in _RANGES:
        raise UserError(f"{DISCOVERY_RANGE}={reach} is not one of {', '.join(_RANGES)}")
    closed = not is_network_enabled(environment)
    local_only = environment.get("ROS_LOCALHOST_ONLY", "").startswith("1")
    if local_only and not closed:
        raise UserError(f"ROS_LOCALHOST_ONLY=1 contradicts {DISCOVERY_RANGE}={reach}: unset one")
    domain = environment.get("ROS_DOMAIN_ID") or "0"
    no_domain = not re.fullmatch("0|[1-9][0-9]{0,2}", domain) or int(domain) > _LAST_DOMAIN
    if no_domain and not own_graph:
        raise UserError(f"ROS_DOMAIN_ID={domain} is not a number from 0 to {_LAST_DOMAIN}")
    profiles = Path(environment.get(PROFILES) or THIS_MACHINE)
    decides = "it decides which nodes are reached" if profiles.is_file() else ""
    # Variable, whether to warn, whether to remove it, effect.
    for name, is_reported, is_removed, effect in (
        ("ROS_DOMAIN_ID", no_domain, True, f"it is not a number from 0 to {_LAST_DOMAIN}"),
        (DISCOVERY_RANGE, reach == _OFF, own_graph, "it prevents nodes from finding each other"),
        ("ROS_DISCOVERY_SERVER", True, closed or own_graph, "it limits discovery to a server"),
        ("ROS_LOCALHOST_ONLY", local_only, True, "nodes stay on this machine in any case"),
        ("ROS_STATIC_PEERS", closed, True, f"{DISCOVERY_RANGE}={reach} looks for none"),
        ("FASTDDS_DEFAULT_PROFILES_FILE", True, True, f"Fast DDS reads {PROFILES}"),
        (PROFILES, profiles.name not in _OURS, not decides, decides or "no such file"),
    ):
        if is_reported and environment.get(name):
            ignored = " ignored" if is_removed else ""
            print(f"{name}={environment[name]}{ignored}: {effect}", file=sys.stderr)
            if is_removed:
                del environment[name]


def restrict_discovery(
    environment: MutableMapping[str, str] = os.environ, *, shared_memory: bool = True
) -> None:
    """Limit discovery to this machine, unless the user's discovery range asks for a network.

    A profile file set by the user stays in effect if it exists; a missing one would enable the
    network. The function calls `clean_environment` first.

    Parameters
    ----------
    environment : mutable mapping
        Environment that ROS and Fast DDS read when the first node is created.
    shared_memory : bool
        Whether messages may use shared memory, if the profiles are ours. Opening the shared memory
        of a new process may block this one for 0.33 s.
    """
    clean_environment(environment)
    given = Path(environment.get(PROFILES) or THIS_MACHINE)
    if given.name == THIS_MACHINE_UDP.name:
        # Inherited from a parent process without shared memory.
        environment[DISCOVERY_RANGE] = _LOCALHOST
    reach = environment[DISCOVERY_RANGE] = environment.get(DISCOVERY_RANGE) or _LOCALHOST
    if given.name not in _OURS and given.is_file():
        return
    if is_network_enabled(environment):
        environment[PROFILES] = str(NETWORK if shared_memory else NETWORK_UDP)
    elif shared_memory or reach != _LOCALHOST:
        environment[PROFILES] = str(THIS_MACHINE)
    else:
        environment[PROFILES] = str(THIS_MACHINE_UDP)
        # With LOCALHOST, rmw_fastrtps adds shared memory; these profiles stay local by themselves.
        environment[DISCOVERY_RANGE] = "SYSTEM_DEFAULT"


def is_network_enabled(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether the user asks for a network."""
    if environment.get(PROFILES) == str(THIS_MACHINE_UDP):
        return False
    return (environment.get(DISCOVERY_RANGE) or _LOCALHOST) not in (_LOCALHOST, _OFF)
