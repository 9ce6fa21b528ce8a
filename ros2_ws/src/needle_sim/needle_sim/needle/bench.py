"""Simulated bench: a needle moved by two axes, and its measured tip."""

from __future__ import annotations

import numpy as np

from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray
from needle_sim.needle.tissue import Torsion, measured_tip

# Random stream of the tip noise; streams 0 and 1 belong to the left and the right image.
_TIP_STREAM = 4


class SimulatedBench:
    """Needle plant that follows the positions of the axes.

    Parameters
    ----------
    curvature : float
        Curvature of the needle's path [1/m].
    pitch, roll : float
        Pitch and roll of the tip at the entry point [rad].
    torsion_play : float
        Dead band between base and tip angle, in either direction [rad].
    torsion_lag : float
        First-order lag of the tip angle over inserted length [m].
    tip_noise : float
        Maximum error of a measured coordinate [m].
    seed : int
        Seed of the noise.
    """

    def __init__(
        self,
        *,
        curvature: float,
        pitch: float,
        roll: float,
        torsion_play: float,
        torsion_lag: float,
        tip_noise: float,
        seed: int,
    ) -> None:
        self.insertion = 0.0
        self.rotation = 0.0
        self.plant = NeedlePlant(
            initial_pose(pitch, roll),
            curvature=curvature,
            torsion=Torsion(play=torsion_play, lag_length=torsion_lag),
        )
        self._tip_noise = tip_noise
        self._seed = seed

    def move_to(self, insertion: float, rotation: float) -> None:
        """Move the axes to these positions [m], [rad], and the needle with them."""
        step = (insertion - self.insertion, rotation - self.rotation)
        self.insertion, self.rotation = insertion, rotation
        if step != (0.0, 0.0):
            self.plant.advance(*step)

    @property
    def tip(self) -> FloatArray:
        """True position of the tip in `rig`, shape (3,) [m]."""
        return self.plant.T_rig_tip[:3, 3]

    def measure_tip(self, exposure_number: int) -> FloatArray:
        """Return the tip with the noise of an exposure, in `rig`, shape (3,) [m]."""
        rng = np.random.default_rng([self._seed, exposure_number, _TIP_STREAM])
        return measured_tip(self.tip, self._tip_noise, rng)
