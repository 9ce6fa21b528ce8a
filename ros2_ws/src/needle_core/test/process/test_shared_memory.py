"""What killed processes leave in shared memory is taken away; what somebody uses stays."""

import fcntl
import sys
from pathlib import Path

import pytest

from needle_core.process.ros_domain import own_domain, ports_of
from needle_core.process.shared_memory import (
    dead_ports,
    remove_dead_ports,
    remove_half_made_ports,
)

PORTS = range(7400, 7410)


def make_port(folder: Path, port: int) -> Path:
    """Make the three files of a port; return the one that its listener locks."""
    lock = folder / f"fastrtps_port{port}_el"
    for path in (lock, folder / f"fastrtps_port{port}", folder / f"sem.fastrtps_port{port}_mutex"):
        path.write_bytes(b"")
    return lock


def test_dead_ports_go_and_others_stay(tmp_path: Path) -> None:
    make_port(tmp_path, 7400)
    listener = make_port(tmp_path, 7401)
    make_port(tmp_path, 7410)
    with listener.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert dead_ports(PORTS, tmp_path) == ["fastrtps_port7400"]
        remove_dead_ports(PORTS, tmp_path)
        assert dead_ports(PORTS, tmp_path) == []
        assert (tmp_path / "fastrtps_port7401").exists()
    assert dead_ports(PORTS, tmp_path) == ["fastrtps_port7401"]
    remove_dead_ports(PORTS, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "fastrtps_port7410",
        "fastrtps_port7410_el",
        "sem.fastrtps_port7410_mutex",
    }


def test_a_port_whose_lock_is_gone_goes_too(tmp_path: Path) -> None:
    make_port(tmp_path, 7400).unlink()
    remove_dead_ports(PORTS, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_domain_is_left_as_clean_as_it_is_found() -> None:
    with own_domain() as domain:
        assert dead_ports(ports_of(domain)) == []
        port = Path("/dev/shm") / f"fastrtps_port{ports_of(domain)[11]}"
        port.write_bytes(b"")
    assert not port.exists()


def test_a_port_whose_maker_ended_half_way_goes_and_others_stay(tmp_path: Path) -> None:
    made = {"fastrtps_port7001": 2, "fastrtps_port7002": 3, "fastrtps_0123456789abcdef": 0}
    half = {"fastrtps_port7000": b"", "fastrtps_port7003": word(0), "fastrtps_port7004": word(1)}
    for name, state in made.items():
        (tmp_path / name).write_bytes(word(state))
    for name, data in half.items():
        (tmp_path / name).write_bytes(data)
    listener = make_port(tmp_path, 7005)
    with listener.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        remove_half_made_ports(tmp_path)
    left = {path.name for path in tmp_path.iterdir() if not path.name.endswith(("_el", "_mutex"))}
    assert left == {*made, "fastrtps_port7005"}


def test_a_port_that_is_being_made_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ready = tmp_path / "fastrtps_port7000"
    renewed = tmp_path / "fastrtps_port7001"
    ready.write_bytes(word(1))
    renewed.write_bytes(b"")

    def make_them(_: float) -> None:
        ready.write_bytes(word(2))
        # Somebody else has seen it, too, and makes it anew.
        (tmp_path / "new").write_bytes(word(1))
        (tmp_path / "new").rename(renewed)

    monkeypatch.setattr("needle_core.process.shared_memory.time.sleep", make_them)
    remove_half_made_ports(tmp_path)
    assert ready.exists()
    assert renewed.exists()


def word(state: int) -> bytes:
    return state.to_bytes(4, sys.byteorder)
