"""Exclusive names, ROS domains and Fast DDS's shared memory."""

from __future__ import annotations

import fcntl
import os
import sys
import uuid
from pathlib import Path

import pytest

from needle_core.errors import UserError
from needle_core.process.ros_domain import Claim, ports_of, reserve_domain_id
from needle_core.process.shared_memory import remove_dead_ports, remove_incomplete_ports

PORTS = range(7400, 7410)
FILES = (("fastrtps_port", ""), ("fastrtps_port", "_el"), ("sem.fastrtps_port", "_mutex"))


def test_the_second_claim_names_the_holder_and_a_released_name_is_free() -> None:
    name = f"/device/status {uuid.uuid4()}"
    first, other = Claim(name, "/first"), Claim(f"{name} too", "/other")
    with pytest.raises(UserError, match=rf"/first \(process {os.getpid()}\) has {name}"):
        Claim(name, "/second")
    for _ in range(2):
        first.release()
    Claim(name, "/second").release()
    other.release()


def make_port(folder: Path, port: int) -> Path:
    """Make the three files of a port; return the one that its listener locks."""
    for name, end in FILES:
        (folder / f"{name}{port}{end}").write_bytes(b"")
    return folder / f"fastrtps_port{port}_el"


def test_dead_ports_are_removed_and_others_stay(tmp_path: Path) -> None:
    make_port(tmp_path, 7400)
    listener = make_port(tmp_path, 7401)
    make_port(tmp_path, 7402).unlink()
    make_port(tmp_path, 7410)
    left = {f"{name}7410{end}" for name, end in FILES}
    with listener.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        remove_dead_ports(PORTS, tmp_path)
        held = {f"{name}7401{end}" for name, end in FILES}
        assert {path.name for path in tmp_path.iterdir()} == left | held
    remove_dead_ports(PORTS, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == left


def test_a_domain_has_one_holder_and_is_left_clean() -> None:
    with reserve_domain_id() as domain, reserve_domain_id() as another:
        assert domain != another
        port = Path("/dev/shm") / f"fastrtps_port{ports_of(domain)[11]}"
        port.write_bytes(b"")
    assert not port.exists()


def word(state: int) -> bytes:
    return state.to_bytes(4, sys.byteorder)


def test_incomplete_ports_are_removed_and_others_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = {"fastrtps_port7001": 2, "fastrtps_port7002": 3, "fastrtps_0123456789abcdef": 0}
    half = {"fastrtps_port7000": b"", "fastrtps_port7003": word(0), "fastrtps_port7004": word(1)}
    for name, state in made.items():
        (tmp_path / name).write_bytes(word(state))
    for name, data in half.items():
        (tmp_path / name).write_bytes(data)
    ready, renewed = tmp_path / "fastrtps_port7006", tmp_path / "fastrtps_port7007"
    ready.write_bytes(word(1))
    renewed.write_bytes(b"")

    def go_on_making(_: float) -> None:
        ready.write_bytes(word(2))
        # Another process removes it and creates it again.
        (tmp_path / "new").write_bytes(word(1))
        (tmp_path / "new").rename(renewed)

    monkeypatch.setattr("needle_core.process.shared_memory.time.sleep", go_on_making)
    with make_port(tmp_path, 7005).open("rb") as listener:
        fcntl.flock(listener, fcntl.LOCK_SH)
        remove_incomplete_ports(tmp_path)
    left = {path.name for path in tmp_path.iterdir() if not path.name.endswith(("_el", "_mutex"))}
    assert left == {*made, "fastrtps_port7005", ready.name, renewed.name}
