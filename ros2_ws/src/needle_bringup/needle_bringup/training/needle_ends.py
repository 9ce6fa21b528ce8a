"""Random needle ends in one view, their shadows, and tracks of earlier needles in the gel.

An end is a tube or rod with a ground bevel; a track is a factor on the brightness of the gel.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_bringup.training.samples import moved

Image = NDArray[np.float32]
_FINE = 3
"""Number of sub-pixels across a pixel."""
_TWIN = 0.4  # share of shadows that look like the needle
_FADING = 0.25  # share of ends that lose contrast near the tip, as in real photographs
_FAINT = 0.15  # maximum change of brightness by a track if there is no background
_GEL_PX = 3.0  # maximum motion of the gel
_MOST = 3
_BROKEN, _PIECE_PX, _PIECES = 0.4, (5.0, 80.0), 60  # share of broken tracks; piece length, number
_BLUNT = 0.15  # length of a straight end with its burr, relative to the needle's width


@dataclasses.dataclass(frozen=True)
class Pose:
    """Pose of a needle in a patch.

    Attributes
    ----------
    x, y : float
        End of the shaft's axis [px].
    heading : float
        Direction at the end [rad].
    bend, twist : float
        Curvature at the end, and its change [1/px, 1/px^2].
    radius : float
        Radius of the shaft [px].
    """

    x: float
    y: float
    heading: float
    bend: float
    twist: float
    radius: float

    def coordinates(self, size: int) -> tuple[Image, Image]:
        """Return coordinates along (0 at the end) and across the shaft, on the fine grid [px]."""
        centres = (np.arange(size * _FINE, dtype=np.float32) + np.float32(0.5)) / _FINE
        x, y = np.meshgrid(centres - np.float32(self.x + 0.5), centres - np.float32(self.y + 0.5))
        # Plain floats keep the grid in single precision.
        cos, sin = float(np.cos(self.heading)), float(np.sin(self.heading))
        bend, twist = float(self.bend), float(self.twist)
        along, across = cos * x + sin * y, cos * y - sin * x
        s = np.clip(along, -200.0, 20.0)
        slope = s * (bend + 1.5 * twist * s)
        across = (across - s * s * (0.5 * bend + 0.5 * twist * s)) / np.sqrt(1.0 + slope * slope)
        return along, across

    def slid(self, ahead: float) -> Pose:
        """Return the pose after the needle has moved along its own curve [px]."""
        s = ahead
        aside = 0.5 * self.bend * s**2 + 0.5 * self.twist * s**3
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return dataclasses.replace(
            self,
            x=self.x + cos * s - sin * aside,
            y=self.y + sin * s + cos * aside,
            heading=self.heading + np.arctan(self.bend * s + 1.5 * self.twist * s**2),
            bend=self.bend + 3.0 * self.twist * s,
        )


def random_pose(rng: np.random.Generator, size: int, radius: float) -> Pose:
    """Return a random pose, usually with the end well inside the patch."""
    heading = rng.uniform(0.0, 2 * np.pi)
    x, y = rng.uniform(0.2 * size, 0.8 * size, 2)
    if rng.random() < 0.25:
        out = rng.uniform(0.3, 0.9) * size
        x, y = x + out * np.cos(heading), y + out * np.sin(heading)
    return Pose(x, y, heading, rng.normal(0.0, 1 / 400), rng.normal(0.0, 1 / 80000), radius)


def coarse(fine: Image) -> Image:
    """Average a supersampled image to pixels."""
    size = len(fine) // _FINE
    return np.asarray(cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA), np.float32)


def true_map(pose: Pose, size: int) -> Image:
    """Return the share of each pixel that belongs to the shaft, cut straight at its end."""
    along, across = pose.coordinates(size)
    return coarse(((along <= 0.0) & (np.abs(across) <= pose.radius)).astype(np.float32))


def draw_needle(rng: np.random.Generator, image: Image, pose: Pose) -> Image:
    """Return an image with a needle of random material, light and bevel."""
    size = len(image)
    along, across = pose.coordinates(size)
    rho = np.clip(across / pose.radius, -1.0, 1.0)
    high = np.sqrt(1.0 - rho**2)
    roll = rng.uniform(0.0, 2 * np.pi)
    kinds = rng.uniform([0.0, 0.0, 1.0], [_BLUNT, 1.0, 3.5])
    length = pose.radius * 2 * rng.choice(kinds)
    top = rho * np.cos(roll) + high * np.sin(roll)
    far = rho * np.cos(roll) + high * abs(np.sin(roll))
    inside = np.abs(across) <= pose.radius
    if rng.random() < 0.1:  # a cone
        tube_end = outline_end = -length * np.abs(rho)
    else:
        tube_end, outline_end = -0.5 * length * (1 - top), -0.5 * length * (1 - far)
    tube = inside & (along <= tube_end)
    face = inside & (along > tube_end) & (along <= outline_end)
    ground = cv2.resize(image, (size * _FINE, size * _FINE), interpolation=cv2.INTER_LINEAR)
    near = float(np.median(image))
    metal = _metal(rng, near, along, rho)
    fine = np.where(tube, metal, ground)
    fine = np.where(face, _face(rng, near, along, ground, length), fine)
    if length > 0.0 and rng.random() < 0.4:  # hollow
        middle, wall = -0.5 * length, rng.uniform(0.4, 0.75)
        bore = face & (np.hypot((along - middle) / (0.5 * length), rho) < wall)
        fine = np.where(bore, near * rng.uniform(0.0, 1.2), fine)
    if rng.random() < _FADING:
        begin, left = -2.0 * pose.radius * rng.uniform(0.5, 2.5), rng.uniform(0.1, 0.6)
        fine = ground + (fine - ground) * (1.0 - (1.0 - left) * np.clip(1 - along / begin, 0, 1))
    return coarse(fine.astype(np.float32))


def draw_shadow(rng: np.random.Generator, image: Image, pose: Pose) -> Image:
    """Return an image with the shadow of a needle on the floor: softer, and possibly shorter.

    Often it is as dark and sharp as the needle and touches it. In this case only knowledge of the
    needle's path distinguishes the two, and the net must show both ends.
    """
    twin = rng.random() < _TWIN
    away = rng.uniform(0.0, 10.0 * pose.radius if twin else 45.0) * rng.choice([-1.0, 1.0])
    shift = rng.uniform(-25.0, 25.0 if twin else 10.0)
    cos, sin = np.cos(pose.heading), np.sin(pose.heading)
    other = dataclasses.replace(
        pose,
        x=pose.x + shift * cos - away * sin,
        y=pose.y + shift * sin + away * cos,
        heading=pose.heading + rng.normal(0.0, 0.06),
        radius=pose.radius * (rng.uniform(0.9, 1.1) if twin else rng.uniform(0.8, 2.0)),
    )
    if twin:
        sharp = cv2.GaussianBlur(true_map(other, len(image)), (0, 0), rng.uniform(0.3, 0.8))
        return np.asarray(image * (1.0 - rng.uniform(0.4, 0.9) * sharp), np.float32)
    # A small lamp casts a shadow that is as sharp as the needle.
    softness = float(np.exp(rng.uniform(np.log(0.3), np.log(7.0))))
    soft = cv2.GaussianBlur(true_map(other, len(image)), (0, 0), softness)
    return np.asarray(image * (1.0 - rng.uniform(0.1, 0.8) * soft), np.float32)


def _metal(rng: np.random.Generator, near: float, along: Image, rho: Image) -> Image:
    """Return the brightness of a shaft: a base tone, and reflections of lamps."""
    kind = rng.choice(["dark", "plain", "mirror"], p=[0.3, 0.2, 0.5])
    tone = {
        "dark": rng.uniform(0.0, 0.5) * near,
        "plain": near * rng.choice([rng.uniform(0.2, 0.85), rng.uniform(1.2, 2.5)]),
        "mirror": near * rng.uniform(0.2, 1.3),
    }[kind]
    metal = tone * (1.0 - rng.uniform(0.0, 0.9) * np.abs(rho) ** rng.uniform(1.0, 6.0))
    lamps = 0 if kind == "plain" and rng.random() < 0.5 else rng.integers(kind == "mirror", 4)
    for _ in range(lamps):
        strength = rng.uniform(10.0, 60.0) if kind == "dark" else rng.uniform(30.0, 400.0)
        place = rng.uniform(-0.85, 0.85) + rng.normal(0.0, 0.004) * along
        width = rng.uniform(0.08, 0.5)
        glint = strength * np.exp(-(((rho - place) / width) ** 2))
        if rng.random() < 0.5:  # a reflection ends where the angle no longer matches
            begin, slope = rng.uniform(-70.0, 5.0), rng.uniform(0.3, 12.0) * rng.choice([-1, 1])
            glint = glint / (1.0 + np.exp(np.clip((along - begin) / slope, -30, 30)))
        metal = metal + glint
    if rng.random() < 0.4:  # a rough surface glitters
        speck = rng.standard_normal((len(rho) // 2, len(rho) // 2)).astype(np.float32)
        speck = cv2.resize(speck, rho.shape[::-1], interpolation=cv2.INTER_NEAREST)
        metal = metal * (1.0 + rng.uniform(0.05, 0.4) * speck)
    return np.asarray(np.clip(metal, 0.0, 500.0), np.float32)


def _face(
    rng: np.random.Generator, near: float, along: Image, ground: Image, length: float
) -> Image:
    """Return the brightness of a ground face, which reflects a lamp, darkness, or the floor."""
    kind = rng.choice(["dark", "bright", "grey", "floor"], p=[0.4, 0.3, 0.2, 0.1])
    if kind == "floor":
        return np.asarray(ground * rng.uniform(0.85, 1.15), np.float32)
    tone = {
        "dark": near * rng.uniform(0.0, 0.6),
        "bright": near + rng.uniform(40.0, 300.0),
        "grey": near * rng.uniform(0.6, 1.6),
    }[kind]
    slope = rng.normal(0.0, 0.3) if rng.random() < 0.5 else 0.0
    face = tone * (1.0 + slope * (along / max(length, 1.0)))
    if rng.random() < 0.35:  # a facet reflects a lamp
        begin, end = -np.sort(rng.uniform(0.0, 1.0, 2)) * length
        face = np.where((along < begin) & (along > end), near + rng.uniform(30.0, 350.0), face)
    return np.asarray(np.clip(face, 0.0, 500.0))


# ---- old tracks ---------------------------------------------------------------------------------


def drawn_tracks(rng: np.random.Generator, pose: Pose, size: int, *, faint: bool) -> Image:
    """Return the factor by which old tracks change the brightness of each pixel.

    Parameters
    ----------
    rng : Generator
        Random generator.
    pose : Pose
        Pose of the needle; some tracks run along it and beyond its end.
    size : int
        Width and height [px].
    faint : bool
        Whether to draw only tracks that do not look like a needle.
    """
    factor = np.ones((size, size), np.float32)
    for _ in range(rng.integers(1, _MOST + 1)):
        radius = pose.radius * rng.uniform(0.35, 1.3)
        if rng.random() < 0.35:
            place = pose.slid(rng.uniform(-20.0, 60.0))
            place = dataclasses.replace(
                place, heading=place.heading + rng.normal(0.0, 0.04), radius=radius
            )
        else:
            place = random_pose(rng, size, radius)
        if not faint and rng.random() < 0.45:
            grey = np.full((size, size), rng.uniform(60.0, 180.0), np.float32)
            like_needle = draw_needle(rng, grey, place) / grey
            factor *= faded(like_needle, rng.uniform(0.4, 1.0), rng.choice([0.0, 0.7, 1.5]))
        else:
            factor *= _cloudy(rng, place, size, faint)
    return factor


def shifted_tracks(rng: np.random.Generator, factor: Image) -> Image:
    """Return the tracks in the background image, unchanged or shifted by motion of the gel."""
    if rng.random() < 0.5:
        return factor
    return moved(factor, rng.uniform(0.0, _GEL_PX), rng.uniform(0.0, 2.0 * np.pi))


def faded(factor: Image, strength: float, blur_px: float) -> Image:
    """Return a blurred factor that is closer to 1."""
    if blur_px > 0.0:
        factor = np.asarray(cv2.GaussianBlur(factor, (0, 0), blur_px), np.float32)
    return np.asarray(1.0 + np.float32(strength) * (factor - 1.0), np.float32)


def made_faint(factor: Image) -> Image:
    """Return a factor limited to small changes of brightness."""
    most = float(np.abs(factor - 1.0).max())
    return faded(factor, min(1.0, _FAINT / max(most, 1e-6)), 0.0)


def _cloudy(rng: np.random.Generator, pose: Pose, size: int, faint: bool) -> Image:
    """Return a torn, clouded track that is soft, patchy, and sometimes has two rims."""
    profile = true_map(pose, size)
    sigma = pose.radius * rng.uniform(0.15, 0.9)
    soft = cv2.GaussianBlur(profile, (0, 0), sigma)
    if rng.random() < 0.3:
        soft = np.abs(soft - cv2.GaussianBlur(profile, (0, 0), 2.0 * sigma + 0.5)) * 2.0
    patches = rng.uniform(-0.5, 1.5, (size // 8, size // 8)).astype(np.float32)
    patches = np.clip(cv2.resize(patches, (size, size), interpolation=cv2.INTER_CUBIC), 0.0, 1.0)
    share = rng.uniform(0.0, 0.9)
    soft = soft * (1.0 - share + share * patches)
    if rng.random() < _BROKEN:
        soft = soft * _pieces(rng, pose, size)
    most = _FAINT if faint else rng.choice([0.3, 0.8])
    return np.asarray(np.clip(1.0 + rng.uniform(-most, most) * soft, 0.1, 3.0), np.float32)


def _pieces(rng: np.random.Generator, pose: Pose, size: int) -> Image:
    """Return a mask of the pieces of a broken track."""
    along, _ = pose.coordinates(size)
    shortest, longest = np.log(_PIECE_PX)
    edges = np.cumsum(np.exp(rng.uniform(shortest, longest, _PIECES))) - 2.0 * size
    return coarse(np.searchsorted(edges, along).astype(np.float32) % 2)
