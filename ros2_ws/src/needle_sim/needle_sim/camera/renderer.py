"""Quick renderer: stereo images of a needle in a clear phantom, refracted by its windows."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.camera.clutter import (
    BubbleCloud,
    OcclusionEvent,
    cable_line,
    hand_capsules,
    occlusion_at,
    paper_lines,
    place_bubbles,
    shadow_line,
)
from needle_sim.camera.lighting import place_lamp
from needle_sim.camera.optics import Optics
from needle_sim.camera.scenarios import CLEAN, Scenario
from needle_sim.camera.stereo_rig import StereoRig
from needle_sim.camera.view import GreyImage, SceneState, StaticScene, View
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.needle.se3 import FloatArray

_LINE_SPACING = 0.0003
# Length of the distal end for which visibility is reported [m].
_DISTAL_LENGTH = 0.01
# A blurred shadow needs fewer points, including the last one.
_SHADOW_PART = slice(None, None, -4)
_NOTHING: FloatArray = np.empty((0, 3))

# Random streams at exposure 0: mottle of each view, common objects (bubbles, cable, light), light
# of each view. The sensor noise uses the streams 0 and 1 of each exposure.
_MOTTLE_STREAMS = (2, 3)
_SCENE_STREAM = 5
_LIGHT_STREAMS = (6, 7)
_CABLE_KEY = 1
_SHADOW_KEY = 2
_LAMP_KEY = 3
_PAPER_KEY = 4


class StereoRenderer:
    """Renders the needle in both cameras, refracted by their windows.

    The images show the shaft inside the phantom, dark on bright plastisol in uneven light, the rim
    of the entry hole at rig's origin, the support sheath in front of it, which hides the shaft
    outside, and the disturbances of the scenario. Windows are infinite: the few objects in front of
    the phantom's front face are drawn as if they were inside. Renderers with the same rig, seed and
    scenario produce bit-identical images in any order, because an image depends only on the number
    of its exposure.

    Parameters
    ----------
    rig : StereoRig
        Cameras and phantom.
    seed : int
        Seed, not negative.
    needle : NeedleShape
        Shape of the needle along the tip's path.
    scenario : Scenario
        Disturbances of the images; none by default.
    """

    def __init__(
        self,
        rig: StereoRig,
        seed: int,
        needle: NeedleShape | None = None,
        scenario: Scenario = CLEAN,
    ) -> None:
        self._seed = seed
        self._rig = rig
        self._needle = NeedleShape() if needle is None else needle
        self._scenario = scenario
        optics = [Optics(camera, scenario.lens) for camera in (rig.left, rig.right)]
        rng = np.random.default_rng([seed, 0, _SCENE_STREAM])
        self._drift_phase = float(rng.uniform(0.0, 2.0 * np.pi))
        self.bubbles: BubbleCloud | None = None
        if scenario.bubbles is not None:
            self.bubbles = place_bubbles(scenario.bubbles, rig, rng)
        still = StaticScene(
            bubbles=self.bubbles,
            lamp=place_lamp(self._rng(_LAMP_KEY)),
            lines=paper_lines(rig.half_height, self._rng(_PAPER_KEY)) if scenario.paper else [],
        )
        self._views = tuple(
            View(
                optics[side],
                scenario,
                still,
                np.random.default_rng([seed, 0, _MOTTLE_STREAMS[side]]),
                [seed, 0, _LIGHT_STREAMS[side]],
            )
            for side in (0, 1)
        )

    def render(
        self,
        T_rig_tip: ArrayLike,  # noqa: N803
        centreline: ArrayLike,
        exposure_number: int,
    ) -> tuple[GreyImage, GreyImage]:
        """Return the images of one exposure.

        Parameters
        ----------
        T_rig_tip : array_like, shape (4, 4)
            Pose of the tip in `rig` [m].
        centreline : array_like, shape (N, 3)
            Path of the tip from the entry point, with a spacing of 1 mm or less, the tip last [m];
            a single point means no needle.
        exposure_number : int
            Key of the sensor noise and of moving objects; not negative.

        Returns
        -------
        left, right : ndarray of uint8, shape (image_height, image_width)
            Grey images.
        """
        event = self._event(exposure_number)
        moment = self._moment(T_rig_tip, centreline, exposure_number, event)
        left, right = (
            view.exposure(
                moment,
                event is not None and event.covered and event.blocks[side],
                self._drift_phase,
                np.random.default_rng([self._seed, exposure_number, side]),
            )
            for side, view in enumerate(self._views)
        )
        return left, right

    def visible_share(
        self,
        T_rig_tip: ArrayLike,  # noqa: N803
        centreline: ArrayLike,
        exposure_number: int,
    ) -> tuple[float, float]:
        """Return the visible share of the needle's last 10 mm in the left and the right image.

        Hands, covers and the image's bounds hide the needle: 0 is hidden or absent, 1 is in full
        view. The arguments are those of `render`.
        """
        event = self._event(exposure_number)
        moment = self._moment(T_rig_tip, centreline, exposure_number, event)
        distal = moment.needle[-int(_DISTAL_LENGTH / _LINE_SPACING) :]
        left, right = (
            0.0
            if event is not None and event.covered and event.blocks[side]
            else view.visible_share(distal, moment)
            for side, view in enumerate(self._views)
        )
        return left, right

    def _event(self, exposure_number: int) -> OcclusionEvent | None:
        return occlusion_at(self._seed, exposure_number) if self._scenario.occlusion else None

    def _moment(
        self,
        T_rig_tip: ArrayLike,  # noqa: N803
        centreline: ArrayLike,
        exposure_number: int,
        event: OcclusionEvent | None,
    ) -> SceneState:
        scenario, height = self._scenario, self._rig.half_height
        pose = np.asarray(T_rig_tip, dtype=np.float64)
        needle = shadow = cable = _NOTHING
        fall = np.empty(0)
        if scenario.needle:
            path = np.asarray(centreline, dtype=np.float64)
            needle = self._needle.shaft_centreline(pose, path, _LINE_SPACING)
        if scenario.shadow is not None and len(needle):
            part = needle[_SHADOW_PART]
            shadow, fall = shadow_line(scenario.shadow, height, part, self._rng(_SHADOW_KEY))
        if scenario.cable:
            cable = cable_line(height, exposure_number, self._rng(_CABLE_KEY))
        return SceneState(
            number=exposure_number,
            needle=needle,
            diameter=self._needle.diameter,
            shadow=shadow,
            shadow_fall=fall,
            cable=cable,
            hand=[]
            if event is None or event.covered
            else hand_capsules(event, pose[:3, 3], self._rig),
        )

    def _rng(self, key: int) -> np.random.Generator:
        """Return a generator in the same state for every exposure."""
        return np.random.default_rng([self._seed, 0, _SCENE_STREAM, key])
