"""Discovery range of a node: this machine, unless the user asks for a network."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from needle_core.errors import UserError
from needle_core.process.discovery import (
    DISCOVERY_RANGE,
    NETWORK,
    NETWORK_UDP,
    PROFILES,
    THIS_MACHINE,
    THIS_MACHINE_UDP,
    clean_environment,
    is_network_enabled,
    restrict_discovery,
)

_NAMES = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"
SERVER, LOCALHOST_ONLY = "ROS_DISCOVERY_SERVER", "ROS_LOCALHOST_ONLY"


def kept(**environment: str) -> dict[str, str]:
    restrict_discovery(environment)
    return environment


@pytest.fixture
def own(tmp_path: Path) -> str:
    """Discovery profiles of the user."""
    (tmp_path / "profiles.xml").touch()
    return str(tmp_path / "profiles.xml")


@pytest.mark.parametrize(
    ("asked", "profiles", "without_shared_memory"),
    [
        ("", THIS_MACHINE, THIS_MACHINE_UDP),
        ("LOCALHOST", THIS_MACHINE, THIS_MACHINE_UDP),
        ("OFF", THIS_MACHINE, THIS_MACHINE),
        ("SUBNET", NETWORK, NETWORK_UDP),
        ("SYSTEM_DEFAULT", NETWORK, NETWORK_UDP),
    ],
)
def test_the_discovery_range_decides_with_and_without_shared_memory(
    asked: str, profiles: Path, without_shared_memory: Path
) -> None:
    opened = profiles is NETWORK
    for before in ("", str(THIS_MACHINE), str(NETWORK), "/another/checkout.xml"):
        environment = kept(**{DISCOVERY_RANGE: asked, PROFILES: before})
        assert environment == {DISCOVERY_RANGE: asked or "LOCALHOST", PROFILES: str(profiles)}
        assert is_network_enabled(environment) is opened
    environment = {DISCOVERY_RANGE: asked}
    restrict_discovery(environment, shared_memory=False)
    assert environment[PROFILES] == str(without_shared_memory)
    assert is_network_enabled(environment) is opened
    # Processes started by such a node use shared memory again.
    restrict_discovery(environment)
    assert environment == kept(**{DISCOVERY_RANGE: asked})
    assert kept() == {DISCOVERY_RANGE: "LOCALHOST", PROFILES: str(THIS_MACHINE)}


def test_profiles_of_the_user_stay_and_are_named(
    own: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for shared_memory in (True, False):
        environment = {PROFILES: own}
        restrict_discovery(environment, shared_memory=shared_memory)
        assert environment == {DISCOVERY_RANGE: "LOCALHOST", PROFILES: own}
        assert capsys.readouterr().err == f"{PROFILES}={own}: it decides which nodes are reached\n"


@pytest.mark.parametrize(
    ("variable", "value", "effect"),
    [
        ("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp", "the rig's nodes run on rmw_fastrtps_cpp"),
        (SERVER, "10.0.0.1:11811", "it limits discovery to a server"),
        ("ROS_STATIC_PEERS", "10.0.0.1", f"{DISCOVERY_RANGE}=LOCALHOST looks for none"),
        (LOCALHOST_ONLY, "1", "nodes stay on this machine in any case"),
        ("FASTDDS_DEFAULT_PROFILES_FILE", "/mine.xml", f"Fast DDS reads {PROFILES}"),
        (PROFILES, "/not/there.xml", "no such file"),
    ],
)
def test_variables_of_another_setup_are_reported_and_removed(
    capsys: pytest.CaptureFixture[str], variable: str, value: str, effect: str
) -> None:
    after = kept(**{variable: value})
    assert capsys.readouterr().err == f"{variable}={value} ignored: {effect}\n"
    middleware = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
    assert after == {**(middleware if variable in middleware else {}), **kept()}
    assert capsys.readouterr().err == ""


def test_variables_that_ask_for_a_network_stay_and_are_reported(
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = {DISCOVERY_RANGE: "SUBNET", "ROS_STATIC_PEERS": "10.0.0.1", SERVER: "a:1"}
    assert kept(**asked) == {**asked, PROFILES: str(NETWORK)}
    assert kept(**{DISCOVERY_RANGE: "OFF"})[DISCOVERY_RANGE] == "OFF"
    assert capsys.readouterr().err.splitlines() == [
        f"{SERVER}=a:1: it limits discovery to a server",
        f"{DISCOVERY_RANGE}=OFF: it prevents nodes from finding each other",
    ]


def test_missing_or_contradictory_settings_are_rejected(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(UserError, match=f"{DISCOVERY_RANGE}=subnet is not one of LOCALHOST"):
        kept(**{DISCOVERY_RANGE: "subnet"})
    with pytest.raises(UserError, match=f"{LOCALHOST_ONLY}=1 contradicts {DISCOVERY_RANGE}=SUBNET"):
        kept(**{DISCOVERY_RANGE: "SUBNET", LOCALHOST_ONLY: "1"})
    for domain in ("", "0", "232"):
        assert kept(ROS_DOMAIN_ID=domain)["ROS_DOMAIN_ID"] == domain
    assert capsys.readouterr().err == ""
    for domain in ("233", "-1", "7abc", "1" * 5000):
        with pytest.raises(UserError, match=f"^ROS_DOMAIN_ID={domain} is not a number from 0 to 2"):
            kept(ROS_DOMAIN_ID=domain)
        # Nodes that are started together have their own domain.
        environment = {"ROS_DOMAIN_ID": domain}
        clean_environment(environment, own_graph=True)
        assert environment == {}
        assert capsys.readouterr().err.startswith(f"ROS_DOMAIN_ID={domain} ignored: ")


@pytest.mark.parametrize("file", [THIS_MACHINE, THIS_MACHINE_UDP])
def test_a_profile_of_this_machine_is_restricted_to_loopback(file: Path) -> None:
    listed = ElementTree.parse(file).getroot().iter(f"{_NAMES}interfaceWhiteList")
    assert [address.text for one in listed for address in one] == ["127.0.0.1"]
