"""From both images to the set-points made from them, in the whole graph of a rig in real time.

Tracker, controller, driver, recorder and console run as on a rig; its drives are emulated, and its
cameras show what was drawn before: no renderer shares the processor with what is measured. A first
insertion, in one process, says how the needle goes; the second goes the same way.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

import latency_rig
import needle_tracker
from campaign.trials.steered_needle import FRAME_RATE, OFFSET, steer
from campaign.trials.trial_processes import TrialProcesses
from needle_bags.reading.bag_reader import read_run
from needle_bags.run.stage_timing import stage_timings
from needle_bringup.simulation.rig_configuration import GRAPH_WATCHDOG, can_adapter
from needle_core.component import Actions
from needle_core.errors import UserError
from needle_core.process.ros_domain import reserve_domain_id
from needle_core.settings.parameter_files import Parameters
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.sensors import TipSensor
from scenario.virtual_rig import Held

CALIBRATION = Path(needle_tracker.__file__).resolve().parents[1] / "config" / "calibration.yaml"
FRAME = 1.0 / FRAME_RATE
SPEED, DEPTH = 0.002, 0.030
# Images count from here: before, the tracker believes the insertion [m].
FIRST = 0.006
_SPACING = 6e-5
_LOOPBACK = "127.0.0.1"
STAGES = ("tracker", "controller", "driver", "image to set-point")


def measure(depth: float = DEPTH) -> Mapping[str, tuple[float, float]]:
    """Steer a needle so deep [m]; return by stage the median and 99 % of its time [s].

    Raises
    ------
    UserError
        If the graph does not get there.
    """
    with tempfile.TemporaryDirectory(prefix="needle_bench_") as name:
        folder = Path(name)
        draw(folder, depth + OFFSET)
        _run(folder, depth)
        run = read_run(folder / "bag")
        timings = {timing.name: timing for timing in stage_timings(run)}
    figures = {}
    for stage in STAGES:
        timing = timings[stage]
        seconds = timing.seconds[run.insertion_at(timing.stamps) > FIRST]
        figures[stage] = (float(np.median(seconds)), float(np.percentile(seconds, 99)))
    return figures


class _DrawingSensor(TipSensor):
    """Tells the tip, and draws the needle on its way."""

    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self._renderer = StereoRenderer(load_stereo_rig(CALIBRATION), 1)
        self.insertions: list[float] = []
        self.images: list[tuple[np.ndarray, np.ndarray]] = []

    def expose(self, number: int, stamp_ns: int) -> Actions:
        bench = self._bench
        if not self.insertions or bench.insertion - self.insertions[-1] > _SPACING:
            self.insertions.append(bench.insertion)
            plant = bench.plant
            pose, line = plant.T_rig_tip, plant.centreline(1e-3)
            self.images.append(self._renderer.render(pose, line, number))
        return super().expose(number, stamp_ns)


def draw(folder: Path, depth: float) -> None:
    """Steer a needle in this process, and leave images of it on its way in a folder."""
    sensors: list[_DrawingSensor] = []

    def see(*parts: Any) -> _DrawingSensor:
        sensors.append(_DrawingSensor(*parts))
        return sensors[0]

    hold = lambda seconds: Held(pressed=seconds > 0.2)  # noqa: E731
    steer(hold, 1, latency=0.01, see=see, depth=depth, nominal_speed=SPEED)
    np.save(folder / latency_rig.IMAGES_FILE, np.array(sensors[0].images))
    np.save(folder / latency_rig.INSERTIONS_FILE, np.array(sensors[0].insertions))


def _run(folder: Path, depth: float) -> None:
    adapter = str(can_adapter())
    parameters: Parameters = {
        "recorder": {"bag": str(folder / "bag")},
        "drive_emulator": {"pty": adapter},
        # Emulated drives are processes: on a busy machine they answer as late as others.
        "device_driver": {
            "channel": adapter,
            **dict.fromkeys(("watchdog", "reply_age_limit", "hold_timeout"), GRAPH_WATCHDOG),
        },
        "stereo_tracker": {},
        "plane_controller": {
            "insertion": "continuous",
            "target_offset": OFFSET,
            "depth": depth + OFFSET,
            "nominal_speed": SPEED,
        },
        "console": {"address": _LOOPBACK, **_free_ports()},
    }
    rig = [sys.executable, latency_rig.__file__, str(folder), str(CALIBRATION), str(depth)]
    with (
        reserve_domain_id() as domain,
        closing(TrialProcesses(folder, domain, parameters)) as graph,
    ):
        done = subprocess.run(
            rig,
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
            capture_output=True,
            text=True,
            check=False,
        )
        graph.check()
    if done.returncode:
        raise UserError(f"the needle did not arrive: {done.stderr.strip().splitlines()[-1]}")


def _free_ports() -> dict[str, object]:
    """Return two ports for the console's page and hold that nobody has now."""
    with socket.socket() as page, socket.socket() as hold:
        for each in (page, hold):
            each.bind((_LOOPBACK, 0))
        return {"port": page.getsockname()[1], "hold_port": hold.getsockname()[1]}
