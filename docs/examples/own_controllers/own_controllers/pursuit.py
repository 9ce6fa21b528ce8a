"""A control law: turn the bevel so that the needle bends towards a place ahead."""

import numpy as np

AHEAD = 0.04  # of the plane, the place looked at is so far ahead [m]


class Pursuit:
    """Turns the base by the angle between the bevel and where it is to go, as fast as it may."""

    def __init__(self, settings):
        self.settings = settings

    def to_plane(self, estimate, insertion):
        """Return the rotation rate [rad/m] that leads into the plane x = 0."""
        place = estimate.position.copy()
        place[0] = 0.0
        place[2] += AHEAD
        return self.to_point(estimate, place)

    def to_point(self, estimate, target):
        """Return the rotation rate [rad/m] that leads to a point of the target plane's frame."""
        way = estimate.rotation.T @ (target - estimate.position)
        # The needle bends to -y of the tip.
        error = np.arctan2(way[0], -way[1])
        return error / self.settings.step_length
