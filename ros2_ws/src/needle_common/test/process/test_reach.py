"""Who reaches a node."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from needle_common.process.reach import (
    DISCOVERY_RANGE,
    NETWORK,
    PROFILES,
    THIS_MACHINE,
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


def test_the_two_files_differ_in_the_list_of_interfaces_only() -> None:
    closed, opened = (ElementTree.parse(file).getroot() for file in (THIS_MACHINE, NETWORK))
    lists = [
        (parent, child)
        for parent in closed.iter()
        for child in parent
        if child.tag == f"{_NAMES}interfaceWhiteList"
    ]
    assert [address.text for _, one in lists for address in one] == ["127.0.0.1"]
    for parent, child in lists:
        parent.remove(child)

    def flat(root: ElementTree.Element) -> list[tuple[str, dict[str, str], str]]:
        return [(e.tag, e.attrib, (e.text or "").strip()) for e in root.iter()]

    assert flat(closed) == flat(opened)
