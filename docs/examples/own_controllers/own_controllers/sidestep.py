"""A planner: straight to the target, or via a point next to the first obstacle in the way."""

import numpy as np

# Clearance from the surface of an obstacle [m]; from farther away it may not bend back in time.
CLEAR = 0.002


class Sidestep:
    """Knows one via point at most; needle, obstacles and target are in `rig`."""

    def __init__(self, settings):
        self.settings = settings

    def via_points(self, tip, target, obstacles):
        """Return the places to steer towards, the target last; None where there is no way."""
        way = target - tip.position
        far = np.linalg.norm(way)
        for start, end, radius in sorted(
            ((row[:3], row[3:6], row[6]) for row in obstacles), key=lambda one: one[0][2]
        ):
            middle = (start + end) / 2.0
            along = (middle - tip.position) @ way / far
            foot = tip.position + along * way / far
            off = foot - middle
            if not 0.01 < along < far or np.linalg.norm(off) > radius + CLEAR:
                continue
            beside = off / np.linalg.norm(off) if off.any() else np.array([0.0, 1.0, 0.0])
            return np.array([middle + (radius + CLEAR) * beside, target])
        return np.array([target])
