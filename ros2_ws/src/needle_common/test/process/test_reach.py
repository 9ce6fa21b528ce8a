"""Who reaches a node."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from needle_common.process.reach import (
    DISCOVERY_RANGE,
    NETWORK,
    NETWORK_UDP,
    PROFILES,
    THIS_MACHINE,
    THIS_MACHINE_UDP,
    is_open,
    keep_to_this_machine,
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
