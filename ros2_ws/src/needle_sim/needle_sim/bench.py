"""Simulated bench: a needle moved by two axes."""

from __future__ import annotations

from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray
from needle_sim.needle.tissue import Torsion
from needle_sim.sim_rig_parameters import SimRigParameters


class SimulatedBench:
    """Needle plant that follows the positions of the axes.

    Parameters
    ----------
    settings : SimRigParameters
        Parameters of the rig: curvature, initial pose and torsion of the needle.
    """

    def __init__(self, settings: SimRigParameters) -> None:
        self.insertion = 0.0
        self.rotation = 0.0
        self.plant = NeedlePlant(
            initial_pose(settings.initial_pitch, settings.initial_roll),
            curvature=settings.curvature,
            torsion=Torsion(settings.torsion_play, settings.torsion_lag),
        )

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
