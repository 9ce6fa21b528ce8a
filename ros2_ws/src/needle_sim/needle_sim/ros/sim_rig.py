"""The `sim_rig` executable."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping

from needle_core.component import RealPort
from needle_core.ports.worker_process import WorkerProcess
from needle_core.ros.main import run_component
from needle_sim.sim_rig import SimRig
from needle_sim.sim_rig_parameters import SimRigParameters

HELP = """\
sim_rig: simulates the rig; every other node runs as on the real rig.

Publishes   sim/tip_pose (the true tip);
            levels tip and camera: joint_states, device/status, device/result;
            level tip: needle/tip, needle/tip_pose;
            levels camera and drive: stereo/{left,right}/{image_raw,camera_info};
            level drive: device/estop, if the tip leaves the phantom
Subscribes  needle/controller_status;
            levels tip and camera: device/joint_trajectory, device/hold, device/estop;
            level drive: sim/drive_positions, which moves the needle
Services    levels tip and camera: device/{home,retract,stop,reset},
            device/{enable,confirm_needle_out}
"""


def _make(settings: SimRigParameters, name: str) -> SimRig:
    if settings.level == "tip":
        return SimRig(settings, name, now=time.monotonic())
    # Loading the renderer takes a long time, and level tip does not need it.
    from needle_sim.cameras import PublishedRemoteCameras  # noqa: PLC0415

    return SimRig(settings, name, PublishedRemoteCameras, time.monotonic())


def _ports(settings: SimRigParameters) -> Mapping[str, RealPort]:
    if settings.level == "tip":
        return {}
    from needle_sim.cameras import CAMERAS, make_renderer  # noqa: PLC0415

    return {CAMERAS: WorkerProcess(make_renderer, settings)}


def main() -> int:
    """Run the node; return its exit code."""
    return run_component("sim_rig", SimRigParameters, _make, help_text=HELP, ports=_ports)


if __name__ == "__main__":
    sys.exit(main())
