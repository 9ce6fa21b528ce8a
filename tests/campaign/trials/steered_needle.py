"""One continuous insertion on a virtual clock: controller, driver, emulated drives and needle."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from typing import Any

import numpy as np

from needle_controller.plane_controller import PlaneController
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.component import Actions, Moment
from needle_device_driver.conformance.rig import FASTEST, ConformanceRig, HandState, RigClient
from needle_sim.bench import SimulatedBench
from needle_sim.sensors import Sensor, TipSensor
from needle_sim.sim_rig import SimRig
from needle_sim.sim_rig_parameters import SimRigParameters
from scenario.transport_faults import delay

OFFSET = 0.003
TIP_STD = 5e-5
"""Standard deviation of a tip measured by the cameras [m]."""
FRAME_RATE = 30.0
_LONGEST = 600.0
Hand = Callable[[float], HandState]
"""Function from the time since the begin of steering [s] to the state of the hand."""


class _SteeredRig(SimRig):
    """Moves the needle, and updates the hand in each cycle."""

    update: Callable[[SimulatedBench, float], None] = staticmethod(lambda *_: None)

    def _cycle(self, at: Moment) -> Actions:
        yield from super()._cycle(at)
        self.update(self._bench, at.steady)


def steer(
    hand: Hand,
    seed: int,
    *,
    pushed: bool = False,
    latency: float = 0.033,
    new_sensor: Callable[[SimulatedBench, SimRigParameters], Sensor] = TipSensor,
    **settings: float,
) -> tuple[str, np.ndarray]:
    """Steer a needle to the end; return the final state of the controller, and the path of the tip.

    Parameters
    ----------
    hand : Hand
        Holds or pushes.
    seed : int
        Seed of the needle, the noise of its tip, and the runner.
    pushed : bool
        Whether a hand moves the insertion axis.
    latency : float
        Time from an exposure to the controller [s].
    new_sensor : callable
        Constructs the tip sensor.
    **settings : float
        Settings of the controller.

    Returns
    -------
    str, ndarray of shape (n, 2)
        The state; insertion and distance from the rig's axis along x [m], each 20 ms.
    """
    rng = np.random.default_rng([seed, 1])
    values: dict[str, Any] = {"depth": 0.12, "nominal_speed": FASTEST, **settings}
    steering = SteeringSettings(
        insertion="continuous",
        target_offset=OFFSET,
        tip_covariance="configured",
        tip_noise="normal",
        measurement_std=TIP_STD,
        **values,
    )
    needle = SimRigParameters(
        level="drive",
        seed=seed,
        curvature=steering.curvature * rng.uniform(0.95, 1.05),
        initial_pitch=math.radians(rng.uniform(-5.0, 5.0)),
        initial_roll=math.radians(rng.uniform(-20.0, 20.0)),
        tip_noise=TIP_STD * math.sqrt(3.0),
        camera_rate=FRAME_RATE,
    )
    sim = _SteeredRig(needle, new_sensor=new_sensor)
    driver = {"max_depth": steering.depth + 0.01, "insertion_drive": "hand" if pushed else "cia402"}
    late = (delay("needle/tip", latency),)
    controller, client = PlaneController(steering), RigClient(steers=False)
    rig = ConformanceRig(seed, sim, controller, hand=client, driver=driver, faults=late)
    rig.home()
    rig.call("plane_controller/start")
    rig.until(lambda: controller.steering.is_steering, "steering")
    begun, before = rig.runner.now, rig.runner.now
    motor = rig.drives.bus.drives["insertion"].motor
    counts = rig.drives.settings.insertion_counts_per_unit
    path: list[tuple[float, float]] = []

    def update(bench: SimulatedBench, now: float) -> None:
        nonlocal before
        rig.hand.state = held = hand(now - begun)
        motor.position += held.push * (now - before) * counts
        before = now
        path.append((bench.insertion, float(bench.tip[0])))

    sim.update = update
    while controller.steering.is_steering and rig.runner.now < begun + _LONGEST:
        rig.runner.run(0.1)
    return controller.steering.state.value, np.array(path)


def rms_at_end(path: np.ndarray, length: float = 0.02) -> float:
    """Return the RMS distance from the plane x = `OFFSET` over the last `length` of a path [m]."""
    grid = np.linspace(path[-1, 0] - length, path[-1, 0], 201)
    return math.sqrt(float(np.mean((np.interp(grid, *path.T) - OFFSET) ** 2)))


# ---- hands --------------------------------------------------------------------------------------


def constant_speed(speed: float) -> Hand:
    """Return a hand that holds at a speed [m/s]."""
    return lambda _: HandState(True, speed / FASTEST)


def changing(rng: np.random.Generator) -> Hand:
    """Return a hand that changes speed, stops or releases every 0.3 to 3 s."""
    share = _pieces(rng)

    def hand(time: float) -> HandState:
        u = share(time)
        return HandState(u >= 0.1, 0.0 if u < 0.2 else u)

    return hand


def pushing(rng: np.random.Generator) -> Hand:
    """Return a hand that pushes the needle itself, with jerks to 20 mm/s, stops and releases."""
    share = _pieces(rng)
    jerks = rng.uniform(size=round(_LONGEST / 0.05)) < 0.03

    def hand(time: float) -> HandState:
        u = share(time)
        jerk = jerks[int(time / 0.05)]
        push = 0.02 if jerk else 0.0 if u < 0.2 else u * FASTEST
        return HandState(True, push=push) if u >= 0.1 else HandState(False)

    return hand


def _pieces(rng: np.random.Generator) -> Callable[[float], float]:
    ends = np.cumsum(rng.uniform(0.3, 3.0, size=round(_LONGEST))).tolist()
    shares = rng.uniform(size=len(ends) + 1)
    return lambda time: float(shares[bisect_right(ends, time)])
