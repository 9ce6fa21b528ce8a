"""README and docs, executed verbatim on the simulated rig, with shorter insertions."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest
import yaml

from campaign.typed_pages import PAGES, ROOT, Session, blocks
from needle_core.process.ros_domain import reserve_domain_id
from needle_tracker.calibrating.calibration_session import parse_session

SHORT_MM = 6
# Insertion that determines a curvature [mm].
ARC_MM = 12
SHARED = ("README.md", "docs", "ros2_ws")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return a folder of links to this checkout, with its own bags."""
    folder = tmp_path / "needle"
    (folder / "bags").mkdir(parents=True)
    for name in SHARED:
        (folder / name).symlink_to(ROOT / name)
    (folder / "scripts").mkdir()
    for path in (ROOT / "scripts").iterdir():
        (folder / "scripts" / path.name).symlink_to(path)
    # In another folder, numerical code would be compiled again.
    (folder / "scripts" / "env.sh").unlink()
    (folder / "scripts" / "env.sh").write_text(f". '{ROOT}/scripts/env.sh'\n")
    (folder / "bags" / "README.md").symlink_to(ROOT / "bags" / "README.md")
    return folder


@pytest.fixture(scope="module")
def runs() -> dict[str, str]:
    """Return the bag of each executed command line of `simulate`, without --bag."""
    return {}


def shortened(scratch: Path, runs: dict[str, str]) -> Callable[[str], str]:
    """Return a function that shortens insertions, redirects files, and gives drives priority."""
    numbers = count()

    def change(command: str) -> str:
        command = command.replace("/tmp/", f"{scratch}/")
        if "docs/examples/" in command and "\n" in command:
            # A run of a few seconds, including its nodes.
            return command
        if "plane_controller" in command:
            return f"{command} -p depth:=0.00{SHORT_MM}"
        if re.search(r"ros2 run \S+ (device_driver|drive_emulator) ", command):
            # In real time even on a busy machine: a rig gives its driver a machine that is not
            # busy. Without the right to raise its priority, it runs with the normal one.
            return f"nice -n -10 {command}"
        if "pip install" in command:
            # Copy the package and link its modules: an editable installation would leave a link.
            folder = command.split()[-1]
            name = Path(folder).name
            copied = command.replace(f"--editable {folder}", f"{scratch}/{name}")
            linked = f"rm -r {scratch}/own/{name}; ln -s $PWD/{folder}/{name} {scratch}/own/"
            return f"cp -rL {folder} {scratch} && {copied} && {linked}"
        if "monte_carlo" in command and "--depth-mm" not in command:
            words, _, _ = command.partition("#")
            return f"{words} --depth-mm {SHORT_MM}"
        if "render_images" in command:
            return f"{command} --frames 8"
        if not command.startswith("scripts/simulate"):
            return command
        words, _, _ = command.partition("#")
        depth = ARC_MM if "--controller open_loop" in words else SHORT_MM
        words = re.sub(r"--depth-mm \d+", "", words) + f" --depth-mm {depth}"
        words = re.sub(r"--target \S+", f"--target 0,0,{SHORT_MM - 1}", words)
        given_bag = re.search(r" --bag (\S+)", words)
        bag = given_bag[1] if given_bag else f"{scratch}/run_{next(numbers)}"
        words = " ".join(words.replace(given_bag[0] if given_bag else "", "").split())
        if given_bag and words in runs:
            return f"cp -r {runs[words]} {bag}"
        if bag.startswith("/"):
            runs[words] = bag
        words += f" --bag {bag}"
        # Such a short insertion may not reach the plane.
        return f"{words}; test $? -le 1"

    return change


def test_the_box_session_is_valid() -> None:
    """Its board is visible from above and from the side; no synthetic rig draws it for the page."""
    page = blocks((ROOT / "docs/calibration.md").read_text("utf-8"))
    (text,) = (block.text for block in page if block.name == "box_session.yaml")
    session = parse_session(yaml.safe_load(text))
    stand, held = session.place_of("stand"), session.place_of("box_3")
    assert stand is not None
    assert held is not None
    assert (stand.is_known, held.is_known) == (True, False)


@pytest.mark.parametrize("page", PAGES)
def test_every_block_works_as_written(
    page: str, checkout: Path, tmp_path: Path, runs: dict[str, str]
) -> None:
    scratch = tmp_path / "t"
    scratch.mkdir()
    with reserve_domain_id() as domain:
        # Packages installed by a page are available to that page only.
        own = f"{scratch}/own"
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "PIP_TARGET": own,
            "PYTHONPATH": f"{own}:{os.environ['PYTHONPATH']}",
        }
        session = Session(checkout, environment, print, shortened(scratch, runs))
        session.type(checkout / page)
    assert session.outputs
    if page == "docs/examples/README.md":
        (from_topics,) = (text for text in session.outputs if "above the plane" in text)
        (above,) = re.findall(r"done, (\S+) mm above the plane", from_topics)
        assert abs(float(above)) < 1.0
        (moved,) = (text for text in session.outputs if "the target moves to" in text)
        assert "plane_controller]: target_point at (0.003, -0.026, 0.1) m" in moved
        assert any("warning: curvature differs" in text for text in session.outputs)
    if page == "docs/hardware.md":
        _, succeeded, joints = session.outputs[-1].partition("frame_id: succeeded")
        assert succeeded, session.outputs[-1]
        insertion, rotation = map(float, re.findall(r"-?\d[\d.e-]*", joints))
        assert insertion == pytest.approx(0.001, abs=1e-5)
        assert rotation == pytest.approx(0.1, abs=2e-3)
