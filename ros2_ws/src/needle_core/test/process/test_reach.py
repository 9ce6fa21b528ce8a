"""Who reaches a node."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from needle_core.errors import UserError
from needle_core.process.reach import (
    DISCOVERY_RANGE,
    NETWORK,
    NETWORK_UDP,
    PROFILES,
    THIS_MACHINE,
    THIS_MACHINE_UDP,
    is_open,
    keep_to_this_machine,
    settle_environment,
)

_NAMES = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"


def kept(**environment: str) -> dict[str, str]:
    keep_to_this_machine(environment)
    return environment


def test_who_says_nothing_is_closed() -> None:
    assert kept() == {DISCOVERY_RANGE: "LOCALHOST", PROFILES: str(THIS_MACHINE)}
    assert not is_open({})


@pytest.mark.parametrize("before", ["", str(THIS_MACHINE), str(NETWORK), "/another/checkout.xml"])
@pytest.mark.parametrize(
    ("asked", "opened"), [("LOCALHOST", False), ("OFF", False), ("SUBNET", True)]
)
def test_the_discovery_range_decides(before: str, asked: str, opened: bool) -> None:
    environment = kept(**{DISCOVERY_RANGE: asked, PROFILES: before})
    assert environment[PROFILES] == str(NETWORK if opened else THIS_MACHINE)
    assert environment[DISCOVERY_RANGE] == asked
    assert is_open(environment) is opened


def test_profiles_of_the_users_own_stay(tmp_path: Path) -> None:
    own = tmp_path / "profiles.xml"
    own.touch()
    assert kept(**{PROFILES: str(own)})[PROFILES] == str(own)


@pytest.mark.parametrize(
    ("asked", "profiles", "opened"),
    [
        ("LOCALHOST", THIS_MACHINE_UDP, False),
        ("OFF", THIS_MACHINE, False),
        ("SUBNET", NETWORK_UDP, True),
        ("SYSTEM_DEFAULT", NETWORK_UDP, True),
    ],
)
def test_without_shared_memory_as_many_are_reached(
    asked: str, profiles: Path, opened: bool
) -> None:
    environment = {DISCOVERY_RANGE: asked}
    keep_to_this_machine(environment, shared_memory=False)
    assert environment[PROFILES] == str(profiles)
    assert is_open(environment) is opened
    # What such a node starts has it again.
    keep_to_this_machine(environment)
    assert environment == kept(**{DISCOVERY_RANGE: asked})


def test_profiles_of_the_users_own_keep_their_shared_memory(tmp_path: Path) -> None:
    own = tmp_path / "profiles.xml"
    own.touch()
    environment = {PROFILES: str(own)}
    keep_to_this_machine(environment, shared_memory=False)
    assert environment == kept(**{PROFILES: str(own)})


@pytest.mark.parametrize(
    ("variable", "value", "effect"),
    [
        ("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp", "the rig's nodes run on rmw_fastrtps_cpp"),
        ("ROS_DISCOVERY_SERVER", "10.0.0.1:11811", "with it, nodes meet at a server only"),
        ("ROS_STATIC_PEERS", "10.0.0.1", f"{DISCOVERY_RANGE}=LOCALHOST looks for none"),
        ("ROS_LOCALHOST_ONLY", "1", "nodes keep to this machine in any case"),
        ("FASTDDS_DEFAULT_PROFILES_FILE", "/mine.xml", f"Fast DDS reads {PROFILES}"),
        (PROFILES, "/not/there.xml", "no such file"),
    ],
)
def test_what_another_set_up_left_is_named_and_dropped(
    capsys: pytest.CaptureFixture[str], variable: str, value: str, effect: str
) -> None:
    after = kept(**{variable: value})
    assert capsys.readouterr().err == f"{variable}={value} ignored: {effect}\n"
    middleware = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
    assert after == {**(middleware if variable in middleware else {}), **kept()}
    assert capsys.readouterr().err == ""


def test_what_asks_for_a_network_stays_and_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "profiles.xml"
    own.touch()
    asked = {
        DISCOVERY_RANGE: "SUBNET",
        "ROS_STATIC_PEERS": "10.0.0.1",
        "ROS_DISCOVERY_SERVER": "10.0.0.1:11811",
        PROFILES: str(own),
    }
    assert kept(**asked) == asked
    assert capsys.readouterr().err.splitlines() == [
        "ROS_DISCOVERY_SERVER=10.0.0.1:11811: with it, nodes meet at a server only",
        f"{PROFILES}={own}: it decides who is reached",
    ]
    assert kept(**{DISCOVERY_RANGE: "OFF"})[DISCOVERY_RANGE] == "OFF"
    assert capsys.readouterr().err == f"{DISCOVERY_RANGE}=OFF: with it, no node finds another\n"


@pytest.mark.parametrize("domain", ["300", "233", "-1", "abc", "7abc", "1.5", "1" * 5000])
def test_a_domain_that_does_not_exist_is_refused(
    capsys: pytest.CaptureFixture[str], domain: str
) -> None:
    with pytest.raises(UserError, match=f"^ROS_DOMAIN_ID={domain} is not a number from 0 to 232$"):
        kept(ROS_DOMAIN_ID=domain)
    # Nodes that are started together have a domain of their own.
    environment = {"ROS_DOMAIN_ID": domain}
    settle_environment(environment, own_graph=True)
    assert environment == {}
    assert capsys.readouterr().err.startswith(f"ROS_DOMAIN_ID={domain} ignored: it is not a numb")


@pytest.mark.parametrize("domain", ["", "0", "7", "232"])
def test_a_domain_that_exists_stays(capsys: pytest.CaptureFixture[str], domain: str) -> None:
    assert kept(ROS_DOMAIN_ID=domain)["ROS_DOMAIN_ID"] == domain
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("asked", ["subnet", "LOCALHSOT", "1"])
def test_a_range_that_does_not_exist_is_refused_and_opens_nothing(asked: str) -> None:
    with pytest.raises(UserError, match=f"{DISCOVERY_RANGE}={asked} is not one of LOCALHOST, SUB"):
        kept(**{DISCOVERY_RANGE: asked})


def test_an_empty_range_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    assert kept(**{DISCOVERY_RANGE: ""}) == kept()
    assert not is_open({DISCOVERY_RANGE: ""})
    assert capsys.readouterr().err == ""


def test_ranges_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(UserError, match=f"ROS_LOCALHOST_ONLY=1 contradicts {DISCOVERY_RANGE}=SUBN"):
        kept(**{DISCOVERY_RANGE: "SUBNET", "ROS_LOCALHOST_ONLY": "1"})


def test_nodes_that_are_started_together_find_each_other(
    capsys: pytest.CaptureFixture[str],
) -> None:
    environment = {DISCOVERY_RANGE: "OFF", "ROS_DISCOVERY_SERVER": "a:1", "CYCLONEDDS_URI": "x"}
    settle_environment(environment, own_graph=True)
    assert environment == {"CYCLONEDDS_URI": "x"}
    environment = {
        DISCOVERY_RANGE: "SUBNET",
        "ROS_DISCOVERY_SERVER": "a:1",
        "ROS_STATIC_PEERS": "b",
    }
    settle_environment(environment, own_graph=True)
    assert environment == {DISCOVERY_RANGE: "SUBNET", "ROS_STATIC_PEERS": "b"}
    assert [line.partition(" ")[0] for line in capsys.readouterr().err.splitlines()] == [
        f"{DISCOVERY_RANGE}=OFF",
        "ROS_DISCOVERY_SERVER=a:1",
        "ROS_DISCOVERY_SERVER=a:1",
    ]


def elements(file: Path, *left_out: str) -> list[tuple[str, str]]:
    """Return the elements of profiles, tag and text; but some, and what is in those."""

    def is_left_out(element: ElementTree.Element) -> bool:
        name = element.tag.removeprefix(_NAMES)
        described = name == "transport_descriptor" and element.findtext(f"{_NAMES}transport_id")
        return {name, described or element.text} & {*left_out} != set()

    def walk(element: ElementTree.Element) -> list[tuple[str, str]]:
        found = [(element.tag, (element.text or "").strip())]
        for child in element:
            if not is_left_out(child):
                found += walk(child)
        return found

    return walk(ElementTree.parse(file).getroot())


def test_the_files_differ_in_interfaces_and_shared_memory_only() -> None:
    assert elements(THIS_MACHINE, "interfaceWhiteList") == elements(NETWORK)
    for file in (THIS_MACHINE, THIS_MACHINE_UDP):
        listed = ElementTree.parse(file).getroot().iter(f"{_NAMES}interfaceWhiteList")
        assert [address.text for one in listed for address in one] == ["127.0.0.1"]
    assert elements(NETWORK, "needle_shm") == elements(NETWORK_UDP)
    # What it means for ROS's layer on Fast DDS to discover this machine alone.
    discovery = ("maxInitialPeersRange", "metatrafficUnicastLocatorList", "initialPeersList")
    assert elements(THIS_MACHINE, "needle_shm") == elements(THIS_MACHINE_UDP, *discovery)
