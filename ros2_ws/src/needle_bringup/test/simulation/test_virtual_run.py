"""The whole rig in this process: it converges despite faults, and stops when it must."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import random
from pathlib import Path
from typing import Any

import cv2
import pytest

from needle_bags.recording.bag_tap import BagTap
from needle_bags.ros import rerun
from needle_bringup.simulation.rig_configuration import command_line_parameters, run_info
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import COMPUTE, make_components
from needle_core.component import Output
from needle_core.runners.transport import Arrival, Arrivals, Fault, Link
from needle_core.runners.virtual import DIAGNOSTICS, LOG, VirtualRunner
from needle_sim.sim_rig import SimRig
from scenario.transport_faults import drop

SHORT = ("--level", "tip", "--depth-mm", "6")
COMMANDS, HOLD, RESULTS, TIP = (
    "device/joint_trajectory",
    "device/hold",
    "device/result",
    "needle/tip",
)
OPERATOR = "simulated_operator"


class Rig:
    """Rig of a command line on a virtual runner, and the messages of its components."""

    def __init__(
        self,
        *arguments: str,
        faults: tuple[Fault, ...] = (),
        bag: Path | None = None,
        **of_rig: Any,
    ):
        self.sent: dict[str, list[Any]] = {}
        options = parse(arguments)
        parameters = command_line_parameters(options, bag or Path("none"))
        parameters["sim_rig"].update(of_rig)
        components = make_components(parameters)
        (self.sim_rig,) = [c for c in components if isinstance(c, SimRig)]
        self.tap = BagTap(bag, components, (DIAGNOSTICS, LOG), run_info(options)) if bag else None
        taps = (self._note, self.tap) if self.tap else (self._note,)
        self.runner = VirtualRunner(components, 1, compute=COMPUTE, faults=faults, taps=taps)

    def _note(self, stamp_ns: int, sender: str, message: Any, output: Output) -> None:
        self.sent.setdefault(output.topic, []).append(message)

    def close(self) -> None:
        """Complete the bag."""
        assert self.tap is not None
        self.tap.close()

    def until_depth(self, depth: float) -> None:
        while self.depth < depth:
            assert not self.runner.run(0.02), self.runner.exits

    def until_end(self) -> int:
        """Run until the operator ends; return its exit code."""
        while not self.runner.run(1.0):
            assert self.runner.now < 90.0
        return self.runner.exits[OPERATOR].code

    @property
    def depth(self) -> float:
        states = self.sent.get("joint_states")
        return float(states[-1].positions[0]) if states else 0.0

    @property
    def outcomes(self) -> set[str]:
        return {result.outcome for result in self.sent[RESULTS]}


def test_a_continuous_run_advances() -> None:
    rig = Rig(*SHORT, "--insertion", "continuous")
    assert rig.until_end() == 0
    assert rig.outcomes == {"replaced", "succeeded"}
    depths = [state.positions[0] for state in rig.sent["joint_states"]]
    begin, end = depths.index(next(d for d in depths if d > 0.001)), depths.index(max(depths))
    pace = [later - before for before, later in itertools.pairwise(depths[begin:end])]
    # 2 mm/s, 50 states a second, without a pause on the way
    assert min(pace[:-5]) > 0.5 * 0.002 / 50
    assert rig.depth == pytest.approx(0.006, abs=1e-5)


@pytest.mark.parametrize("insertion", ["stepwise", "continuous"])
def test_delayed_components_do_not_end_the_run(insertion: str) -> None:
    rig = Rig(*SHORT, "--insertion", insertion)
    for depth, frozen in ((0.001, OPERATOR), (0.003, "plane_controller"), (0.005, "sim_rig")):
        rig.until_depth(depth)
        rig.runner.freeze(frozen, 0.5)
    assert rig.until_end() == 0
    assert rig.depth == pytest.approx(0.006, abs=1e-5)


def test_a_tip_that_leaves_the_phantom_ends_the_run() -> None:
    rig = Rig("--level", "tip", "--controller", "open_loop")
    rig.sim_rig._sensor.half_sizes = (1e-3, math.inf)
    assert rig.until_end() == 1
    assert "the tip left the phantom: x = 1." in rig.runner.exits[OPERATOR].text
    assert 0.8e-3 < rig.sent["sim/tip_pose"][-1].position[0] < 1.1e-3
    assert rig.sent["device/status"][-1].values["state"] == "FAULT"


@pytest.fixture(scope="module")
def lossy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, str]:
    """Return a rig whose tracker missed some images, and the output of its rerun."""
    folder = tmp_path_factory.mktemp("lossy")
    bag, images = folder / "bag", str(folder / "images")
    argv = ("--level", "camera", "--depth-mm", "3")
    lost = (drop("stereo/left/image_raw", 0.4),)
    rig = Rig(*argv, faults=lost, bag=bag, images=images, scenario="clutter")
    assert rig.until_end() == 0
    rig.close()
    with contextlib.redirect_stdout(io.StringIO()) as output:
        assert rerun.main([str(bag)]) == 0
    return rig, output.getvalue()


def test_pairs_are_exposed_only_when_a_tip_is_expected(lossy: tuple[Rig, str]) -> None:
    rig, _ = lossy
    assert rig.depth == pytest.approx(0.003, abs=1e-5)
    pairs, tips = len(rig.sent["stereo/left/image_raw"]), len(rig.sent["needle/tip_pose"])
    # One at each depth, and another a second later if there was no tip.
    assert 4 == tips < pairs < 12


def test_rendered_images_have_insertion_and_truth(lossy: tuple[Rig, str]) -> None:
    rig, _ = lossy
    folder = Path(rig.sim_rig.settings.images)
    for side in ("left", "right"):
        for number, image in enumerate(rig.sent[f"stereo/{side}/image_raw"]):
            written = cv2.imread(str(folder / side / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert written is not None
            assert written.tobytes() == bytes(image.data)
            assert (image.encoding, image.frame_id) == ("mono8", f"{side}_camera_optical")
    lines = (folder / "insertion.csv").read_text().splitlines()
    assert lines[:2] == ["name,insertion_m", "000000.png,0.0"]
    assert float(lines[-1].split(",")[1]) == pytest.approx(0.003)
    last = (folder / "truth.csv").read_text().splitlines()[-1].split(",")
    assert tuple(map(float, last[1:4])) == rig.sent["sim/tip_pose"][-1].position
    assert (folder / "calibration.yaml").is_file()


def test_pairs_that_the_tracker_did_not_receive_are_left_out_of_a_rerun(
    lossy: tuple[Rig, str],
) -> None:
    assert "pairs are left out: stereo_tracker did not receive them" in lossy[1]


def late(latest: float) -> Fault:
    """Return a fault that delays each message to the controller by up to `latest` [s]."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals | None:
        to_controller = link.receiver == "plane_controller"
        return (Arrival(rng.uniform(0.0, latest), message),) if to_controller else None

    return fault


@pytest.mark.parametrize("insertion", ["stepwise", "continuous"])
def test_a_rerun_with_late_messages_is_unchanged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], insertion: str
) -> None:
    """The controller received messages late and was frozen once."""
    argv = ("--level", "tip", "--depth-mm", "2", "--insertion", insertion)
    rig = Rig(*argv, faults=(late(0.04),), bag=tmp_path / "bag")
    rig.until_depth(0.001)
    rig.runner.freeze("plane_controller", 0.2)
    assert rig.until_end() == 0
    rig.close()
    assert rerun.main([str(tmp_path / "bag")]) == 0, capsys.readouterr().out


@pytest.mark.parametrize("drives", ["cia402", "stepdir", "cia402,stepdir"])
def test_at_level_drive_the_needle_follows_the_motors(drives: str) -> None:
    rig = Rig("--level", "drive", "--depth-mm", "1", "--drives", drives)
    assert rig.until_end() == 0
    motors = [at.positions[0] for at in rig.sent["sim/drive_positions"]]
    assert rig.sim_rig._bench.insertion == motors[-1] == pytest.approx(0.001, abs=1e-5)
