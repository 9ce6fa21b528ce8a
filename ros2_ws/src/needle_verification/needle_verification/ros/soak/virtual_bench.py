"""The bench: a needle moved by the motors and nothing else, and what a tracker tells of it."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped

from needle_core.ros.conversions import RELIABLE, to_stamp
from needle_sim.drive_emulator_parameters import DriveEmulatorParameters
from needle_sim.drives.emulated_bus import EmulatedBus, MotionClock
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.tissue import Torsion
from needle_sim.ros.conversions import to_tip, to_tip_pose
from needle_verification.ros.soak.virtual_node import VirtualNode
from needle_verification.soak.virtual_world import VirtualWorld

TICK_NS = 5_000_000
_FRAME_RATE = 20.0
# From exposure to answer [ns], at least and at most.
_ANSWER_NS = (15_000_000, 45_000_000)
# Half width of the noise of a coordinate [m].
TIP_NOISE = 0.0002
_CURVATURE = 1.0 / 0.122
# The needle takes the motors' way in pieces of at most so much [m], [rad].
_PIECE = 0.0002, 0.1


@dataclasses.dataclass(frozen=True)
class Motors:
    """True positions of both motors.

    Attributes
    ----------
    steady_ns : int
        When [ns].
    insertion, rotation : float
        [m], [rad].
    """

    steady_ns: int
    insertion: float
    rotation: float


class Bench:
    """Drives, needle and phantom.

    Parameters
    ----------
    world : VirtualWorld
        Its time and chance.

    Attributes
    ----------
    bus : EmulatedBus
        Both drives.
    motors : Motors
        At the last tick.
    watchers : list of callable
        Called with the motors at every tick.
    deepest_tip : ndarray, shape (3,)
        Where the true tip was when it was farthest in, in `rig` [m].
    """

    def __init__(self, world: VirtualWorld) -> None:
        self._world = world
        drives = DriveEmulatorParameters(boot_time=0.1)
        self.bus = EmulatedBus(drives.insertion, drives.rotation, MotionClock.STEADY, world.steady)
        draw = world.chance("needle").uniform
        self._plant = NeedlePlant(
            initial_pose(draw(-0.1, 0.1), draw(-0.5, 0.5)),
            curvature=_CURVATURE * draw(0.9, 1.1),
            torsion=Torsion(play=draw(0.0, 0.3), lag_length=0.0),
        )
        self.motors = Motors(world.steady_ns, 0.0, 0.0)
        self._taken = self.motors
        self._deepest = 0.0
        self.deepest_tip = self.tip
        self.watchers: list[Callable[[Motors], None]] = []
        self._tick()

    @property
    def tip(self) -> np.ndarray:
        """The true tip in `rig`, shape (3,) [m]."""
        self._follow_motors()
        return self._plant.T_rig_tip[:3, 3]

    def _tick(self) -> None:
        axes = self.bus.axes(self._world.steady)
        at = Motors(self._world.steady_ns, axes["insertion"].position, axes["rotation"].position)
        self.motors = at
        if any(abs(way) > piece for way, piece in zip(self._way, _PIECE, strict=True)):
            self._follow_motors()
        for watch in self.watchers:
            watch(at)
        self._world.call_after(TICK_NS, self._tick)

    @property
    def _way(self) -> tuple[float, float]:
        """Motion of the motors since the needle followed them [m], [rad]."""
        at, taken = self.motors, self._taken
        return at.insertion - taken.insertion, at.rotation - taken.rotation

    def _follow_motors(self) -> None:
        if any(self._way):
            self._plant.advance(*self._way)
        self._taken = self.motors
        if self.motors.insertion > self._deepest:
            self._deepest = self.motors.insertion
            self.deepest_tip = self._plant.T_rig_tip[:3, 3]


class Sight(enum.Enum):
    """States of the cameras."""

    CLEAR = "clear"
    BLACK = "black"
    FROZEN = "frozen"
    WRONG = "wrong"
    LATE = "late"


class TrackerStandIn(VirtualNode):
    """Stands in for the tracker: tells the tip of every exposure.

    Parameters
    ----------
    bench : Bench
        What is seen.

    Attributes
    ----------
    sight : Sight
        What the cameras do.
    """

    def __init__(self, bench: Bench) -> None:
        super().__init__("stereo_tracker")
        self._bench = bench
        self.sight = Sight.CLEAR
        chance = self.place.graph.world.chance
        self._noise, self._delay = chance("tip", "noise"), chance("tip", "delay")
        self._fault = chance("faults", "tip")
        self._last = bench.tip.copy()
        self._tip = self.create_publisher(PointStamped, "needle/tip", RELIABLE)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, "needle/tip_pose", RELIABLE)
        self.create_timer(1.0 / _FRAME_RATE, self._expose)

    def _expose(self) -> None:
        world = self.place.graph.world
        stamp = to_stamp(world.system_ns)
        if self.sight is not Sight.FROZEN:
            noise = [self._noise.uniform(-TIP_NOISE, TIP_NOISE) for _ in range(3)]
            self._last = self._bench.tip + np.array(noise)
        seen = self._last.copy()
        if self.sight is Sight.WRONG:
            seen += [self._fault.uniform(-0.02, 0.02) for _ in range(3)]
        delay_ns = self._delay.randint(*_ANSWER_NS)
        if self.sight is Sight.LATE:
            delay_ns += self._fault.randint(0, 3_000_000_000)
        pose = to_tip_pose(seen, TIP_NOISE, stamp)
        found = self.sight is not Sight.BLACK
        if not found:
            pose.pose.covariance = np.diag([np.inf] * 6).ravel()

        def answer() -> None:
            self._pose.publish(pose)
            if found:
                self._tip.publish(to_tip(seen, stamp))

        world.call_after(delay_ns, lambda: self.place.process.do(answer))
