"""Light of the quick renderer: uneven and changing light, glints, and a bare metal shaft."""

from __future__ import annotations

import cv2
import numpy as np

from needle_sim.camera.optics import FloatImage, Optics
from needle_sim.camera.scenarios import Glints, Lighting, MetalShaft
from needle_sim.camera.stereo_rig import SimulatedCamera
from needle_sim.needle.se3 import FloatArray

_BLOTCH_SIZE = 0.13
_COARSE = 16
_SIDE = 0.05
_LENGTHS = (0.0, 0.140)
_NEEDLE_SIDE = 0.006
_NEEDLE_LENGTHS = (0.02, 0.115)
_SLIMNESS = (0.12, 0.5)
_DRIFT_PERIOD, _FLICKER_PERIOD = 90.0, 23.0  # [exposures]
_SHINE_LENGTHS = (0.0015, 0.0045)
_SHINE = 160.0
_BEND = 0.25


def lamp_light(camera: SimulatedCamera) -> FloatImage:
    """Return the light over the image: a lamp to one side, and vignetting of the lens."""
    u = np.linspace(-1.0, 1.0, camera.image_width, dtype=np.float32)
    v = np.linspace(-1.0, 1.0, camera.image_height, dtype=np.float32)[:, np.newaxis]
    return np.asarray(1.0 + 0.09 * u - 0.06 * v - 0.05 * (u * u + v * v), dtype=np.float32)


def uneven_light(
    lighting: Lighting, camera: SimulatedCamera, rng: np.random.Generator
) -> FloatImage:
    """Return the factor of the lamp's light: wide blotches, and a soft shade on one side."""
    size = (camera.image_width, camera.image_height)
    small = (-(-size[0] // _COARSE), -(-size[1] // _COARSE))
    field = cv2.GaussianBlur(
        rng.standard_normal(small[::-1], dtype=np.float32),
        (0, 0),
        _BLOTCH_SIZE * small[0],
        borderType=cv2.BORDER_REFLECT,
    )
    field = lighting.blotches * (field - field.mean()) / field.std()
    angle = rng.uniform(0.0, 2.0 * np.pi)
    u = np.linspace(-1.0, 1.0, small[0])
    v = np.linspace(-1.0, 1.0, small[1])[:, np.newaxis]
    across = np.cos(angle) * u + np.sin(angle) * v - rng.uniform(0.1, 0.6)
    light = 1.0 + field - lighting.shade / (1.0 + np.exp(-across / 0.06))
    return np.asarray(
        cv2.resize(light.astype(np.float32), size, interpolation=cv2.INTER_CUBIC), dtype=np.float32
    )


def drift(lighting: Lighting, exposure_number: int, phase: float) -> float:
    """Return the factor by which an exposure's light drifts; `phase` is the initial one [rad]."""
    angle = 2.0 * np.pi * exposure_number / _DRIFT_PERIOD + phase
    return float(1.0 + lighting.drift * np.sin(angle))


def flicker(glints: Glints, exposure_number: int, phase: float) -> float:
    """Return the factor by which the surface glints dim; `phase` is the initial one [rad]."""
    angle = 2.0 * np.pi * exposure_number / _FLICKER_PERIOD + phase
    return float(1.0 - glints.flicker * (0.5 + 0.5 * np.sin(angle)))


def surface_glints(glints: Glints, optics: Optics, rng: np.random.Generator) -> FloatImage:
    """Return the glints of lamps on the uneven surface in a camera's image."""
    width, height = optics.image_size
    count = glints.on_surface + glints.over_needle
    over = np.arange(count) >= glints.on_surface
    aside, along = rng.uniform(-_SIDE, _SIDE, count), rng.uniform(*_LENGTHS, count)
    aside[over] = rng.uniform(-_NEEDLE_SIDE, _NEEDLE_SIDE, glints.over_needle)
    along[over] = rng.uniform(*_NEEDLE_LENGTHS, glints.over_needle)
    place = optics.points_on_face(aside, along)
    half = glints.largest / 2.0 * rng.uniform(0.15, 1.0, count) ** 1.5
    half[over] = glints.largest / 2.0 * rng.uniform(0.5, 1.0, glints.over_needle)
    half_px = optics.radius_px(place, half)
    slim = rng.uniform(*_SLIMNESS, count)
    angle = rng.uniform(0.0, np.pi, count)
    bend = rng.uniform(-_BEND, _BEND, count)
    peak = glints.brightness * rng.uniform(0.4, 1.0, count)
    blur = np.broadcast_to(optics.blur_px(place), (count,))
    image = np.zeros((height, width), dtype=np.float32)
    for i, (u0, v0) in enumerate(optics.project(place)):
        reach = int(np.ceil(1.5 * half_px[i] + 3.0 * blur[i]))
        rows = slice(max(int(v0) - reach, 0), max(min(int(v0) + reach + 2, height), 0))
        columns = slice(max(int(u0) - reach, 0), max(min(int(u0) + reach + 2, width), 0))
        u = np.arange(columns.start, columns.stop) - u0
        v = (np.arange(rows.start, rows.stop) - v0)[:, np.newaxis]
        along = (np.cos(angle[i]) * u + np.sin(angle[i]) * v) / np.hypot(half_px[i], blur[i])
        # Slightly bent, as by ripples.
        across = np.cos(angle[i]) * v - np.sin(angle[i]) * u + bend[i] * half_px[i] * along**2
        across /= np.hypot(slim[i] * half_px[i] / 2.0, blur[i])
        image[rows, columns] += peak[i] * np.exp(-(along**4) - across**2)
    return image


def shaft_glints(glints: Glints, length: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the glints on the middle of the shaft at positions along `rig`'s z, (M,).

    The glints are fixed in space, because the needle follows its own path.
    """
    middle = rng.uniform(*_LENGTHS, glints.on_needle)
    half = rng.uniform(*_SHINE_LENGTHS, glints.on_needle) / 2.0
    peak = _SHINE * rng.uniform(0.5, 1.0, glints.on_needle)
    bumps = peak * np.exp(-(((length[:, np.newaxis] - middle) / half) ** 4))
    return np.asarray(bumps.max(axis=1, initial=0.0))


_LAMP_SIDE, _LAMP_HEIGHT, _LAMP_ALONG = (0.1, 0.3), 0.4, (0.02, 0.1)


def place_lamp(rng: np.random.Generator) -> FloatArray:
    """Return the position of a run's lamp, on either side above the phantom, shape (3,) [m]."""
    side = float(rng.choice([-1.0, 1.0])) * rng.uniform(*_LAMP_SIDE)
    return np.array([_LAMP_HEIGHT, side, rng.uniform(*_LAMP_ALONG)])


def lamp_reflection(
    line: FloatArray, camera: FloatArray, lamp: FloatArray, metal: MetalShaft
) -> tuple[FloatArray, FloatArray]:
    """Return the reflection of the lamp on a bare metal shaft: its strength and lateral position.

    A cylinder mirrors the lamp along the line where its normal bisects the angle between lamp and
    camera. Where the shaft bends away from that, the bright core fades and the needle is dark up to
    its end, in one view sooner than in the other. Refraction is neglected, which changes where the
    core fades but not how it looks.

    Parameters
    ----------
    line : ndarray, shape (M, 3)
        Centreline of the shaft in `rig` [m].
    camera, lamp : ndarray, shape (3,)
        Positions in `rig` [m].
    metal : MetalShaft
        Properties of the shaft.

    Returns
    -------
    share : ndarray, shape (M,)
        Share of the lamp's light, 0 to 1.
    place : ndarray, shape (M,)
        Position of the core over the shaft's radius, positive towards `cross(ahead, to camera)`.
    """
    ahead = np.gradient(line, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    to_camera, to_lamp = camera - line, lamp - line
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    to_lamp /= np.linalg.norm(to_lamp, axis=1, keepdims=True)
    between = to_camera + to_lamp
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    off = np.sum(between * ahead, axis=1)
    normal = between - off[:, np.newaxis] * ahead
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    sideways = np.cross(ahead, to_camera)
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    share = np.exp(-((off / metal.spread) ** 2))
    return np.asarray(share), np.asarray(np.sum(normal * sideways, axis=1))
