"""A rig of its own, for tests: cv2.projectPoints, Snell by Fermat's principle, drawn boards."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_tracker.calibrating.calibration_session import Place
from needle_tracker.calibrating.charuco import CharucoBoard
from needle_tracker.calibrating.rig_model import BoardView, Corners
from needle_tracker.optics.window import Window, surface_from_above

Array = NDArray[np.float64]

SIDES = ("left", "right")
BOARD = CharucoBoard()
SIZE = (1024, 768)


def given(height: float, index: float) -> tuple[Window, Window]:
    """What a session file says of the phantom that both cameras look through."""
    return surface_from_above(height, index), surface_from_above(height, index)


def board_image(board: CharucoBoard, square_px: int) -> NDArray[np.uint8]:
    """The pattern as OpenCV draws it, without a margin."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    shape = (board.columns, board.rows)
    pattern = cv2.aruco.CharucoBoard(shape, board.square, board.marker, dictionary)
    pattern.setLegacyPattern(board.legacy)
    image = pattern.generateImage((shape[0] * square_px, shape[1] * square_px))
    return np.asarray(image, dtype=np.uint8)


@dataclasses.dataclass
class TrueRig:
    """What a calibration file says, read without the code under test, and the board it sees."""

    content: dict[str, Any]
    board: CharucoBoard = BOARD

    @classmethod
    def read(cls, path: Path, board: CharucoBoard = BOARD) -> TrueRig:
        return cls(yaml.safe_load(path.read_text()), board)

    @property
    def height(self) -> float:
        return float(self.content["phantom"]["surface_height"])

    @property
    def index(self) -> float:
        return float(self.content["phantom"]["refractive_index"])

    def camera(self, side: str) -> tuple[Array, Array, Array, Array]:
        c = self.content[side]
        matrix = np.reshape(c["camera_matrix"]["data"], (3, 3))
        pose = c["T_optical_rig"]
        rotation = Rotation.from_quat(pose["rotation"]).as_matrix()
        translation = np.array(pose["translation"])
        return matrix, np.array(c["distortion_coefficients"]["data"]), rotation, translation

    def turned(self, side: str, degrees: float, axis: str = "y") -> TrueRig:
        """A rig with one camera turned about an axis of its optical frame."""
        content = yaml.safe_load(yaml.safe_dump(self.content))
        pose = content[side]["T_optical_rig"]
        turn = Rotation.from_euler(axis, degrees, degrees=True)
        pose["rotation"] = (turn * Rotation.from_quat(pose["rotation"])).as_quat().tolist()
        pose["translation"] = turn.apply(pose["translation"]).tolist()
        return dataclasses.replace(self, content=content)

    def with_phantom(self, **values: float) -> TrueRig:
        content = yaml.safe_load(yaml.safe_dump(self.content))
        content["phantom"].update(values)
        return dataclasses.replace(self, content=content)

    def project(self, side: str, points: Array, under: bool) -> Array:
        """Pixels of points in rig; `under` says that they are seen through the window."""
        matrix, distortion, rotation, translation = self.camera(side)
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        if under:
            points = self._crossings(side, -rotation.T @ translation, points)
        pixels, _ = cv2.projectPoints(
            points, cv2.Rodrigues(rotation)[0], translation, matrix, distortion
        )
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)

    def window(self, side: str) -> tuple[Array, Array, list[float], list[float]]:
        """Point, normal; thicknesses and indices from outside inwards, the body's index last."""
        if "phantom" in self.content:
            return np.array([self.height, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), [], [self.index]
        window = self.content[side]["window"]
        thicknesses = [layer["thickness"] for layer in window["layers"]]
        indices = [layer["refractive_index"] for layer in window["layers"]] + [window["inside"]]
        return np.array(window["point"]), np.array(window["normal"]), thicknesses, indices

    def _crossings(self, side: str, centre: Array, points: Array) -> Array:
        """Where light crosses the outer face: by bisection on the sine of its angle in air."""
        face, normal, thicknesses, indices = self.window(side)
        deep = -(points - face) @ normal - sum(thicknesses)
        up = float((centre - face) @ normal)
        foot = centre - up * normal
        aside = points - foot
        aside = aside - (aside @ normal)[:, None] * normal
        distance = np.linalg.norm(aside, axis=1)
        low, high = np.zeros(len(points)), np.ones(len(points))
        for _ in range(80):
            sine = 0.5 * (low + high)
            reach = up * sine / np.sqrt(1.0 - sine**2)
            total = reach
            for t, n in zip([*thicknesses, deep], indices, strict=True):
                total = total + t * np.tan(np.arcsin(sine / n))
            far = total > distance
            low, high = np.where(far, low, sine), np.where(far, sine, high)
        fraction = np.divide(reach, distance, out=np.zeros_like(reach), where=distance > 0)
        return np.asarray(foot + aside * fraction[:, None])

    def view(
        self,
        name: str,
        pose: Array,
        place: Place | None,
        rng: np.random.Generator,
        noise: float = 0.1,
    ) -> BoardView:
        """The board's corners inside both images, with noise."""
        points = self.board.corners
        under = place is not None and place.under_surface
        seen = []
        for side in SIDES:
            pixels = self.project(side, points @ pose[:3, :3].T + pose[:3, 3], under)
            pixels = pixels + rng.normal(0.0, noise, pixels.shape)
            inside = np.all((pixels > 5) & (pixels < np.array(SIZE) - 5), axis=1)
            seen.append(Corners(points[inside], pixels[inside]))
        return BoardView(name, place, seen[0], seen[1])

    def draw(
        self, side: str, pose: Array, under: bool, rng: np.random.Generator, super_px: int = 2
    ) -> NDArray[np.uint8]:
        """A grey image of the board, each pixel mapped back by a fine grid of true projections."""
        shape = (SIZE[1] * super_px, SIZE[0] * super_px)
        square_px = 40 * super_px
        pattern = cv2.copyMakeBorder(
            board_image(self.board, square_px), square_px, square_px, square_px, square_px,
            cv2.BORDER_CONSTANT, value=255,
        )  # fmt: skip
        # The board's plane, as a fine mesh; between its knots the map is smooth.
        n = 4
        u = np.linspace(-1, self.board.columns + 1, n * (self.board.columns + 2) + 1)
        v = np.linspace(-1, self.board.rows + 1, n * (self.board.rows + 2) + 1)
        mesh = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        flat = np.column_stack([mesh * self.board.square, np.zeros(len(mesh))])
        pixels = self.project(side, flat @ pose[:3, :3].T + pose[:3, 3], under)
        pixels = (pixels + 0.5) * super_px - 0.5
        source = ((mesh + 1) * square_px - 0.5).astype(np.float32)
        image = np.full(shape, 130.0, dtype=np.float32)
        rows = len(v)
        grid_s, grid_p = source.reshape(rows, -1, 2), pixels.reshape(rows, -1, 2)
        for i in range(rows - 1):
            for j in range(grid_s.shape[1] - 1):
                cell = [(i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)]
                to = np.array([grid_p[c] for c in cell], dtype=np.float32)
                frm = np.array([grid_s[c] for c in cell], dtype=np.float32)
                low = np.maximum(np.floor(to.min(axis=0)).astype(int), 0)
                high = np.minimum(np.ceil(to.max(axis=0)).astype(int) + 1, shape[::-1])
                if np.any(high <= low):
                    continue
                warp = cv2.getPerspectiveTransform(frm, to - low.astype(np.float32))
                size = tuple(int(x) for x in high - low)
                patch = cv2.warpPerspective(
                    pattern, warp, size, flags=cv2.INTER_LINEAR, borderValue=255
                )
                mask = np.zeros(size[::-1], np.uint8)
                cv2.fillConvexPoly(mask, np.round((to - low) * 16).astype(np.int32), 1, shift=4)
                block = image[low[1] : high[1], low[0] : high[0]]
                block[mask > 0] = 30.0 + patch[mask > 0] * (190.0 / 255.0)
        image = cv2.GaussianBlur(image, (0, 0), 0.7 * super_px)
        image = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
        noisy = image + rng.normal(0.0, 2.0, image.shape)
        return np.asarray(np.clip(np.round(noisy), 0, 255), dtype=np.uint8)


def flat_pose(origin: Any, pitch_deg: float = 0.0, tilt_deg: float = 0.0) -> Array:
    """T_rig_board of a board face up: columns along z, rows along y; then tilted in place."""
    pose = np.eye(4)
    flat = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    pose[:3, :3] = Rotation.from_euler("yz", [pitch_deg, tilt_deg], degrees=True).as_matrix() @ flat
    pose[:3, 3] = origin
    return pose


def free_pose(rng: np.random.Generator, tilts_deg: tuple[float, float] = (15, 42)) -> Array:
    """A board held in the working volume, its middle seen by both cameras, tilted."""
    centre = np.array(
        [rng.uniform(0.06, 0.10), rng.uniform(-0.012, 0.012), rng.uniform(0.05, 0.075)]
    )
    tilt = np.deg2rad(rng.uniform(*tilts_deg))
    axis = rng.uniform(0, 2 * np.pi)
    pose = flat_pose(np.zeros(3))
    turn = Rotation.from_rotvec(tilt * np.array([0.0, np.cos(axis), np.sin(axis)]))
    spin = Rotation.from_euler("x", rng.uniform(-25, 25) + 180 * rng.integers(2), degrees=True)
    pose[:3, :3] = (turn * spin).as_matrix() @ pose[:3, :3]
    middle = np.array([BOARD.size[0] / 2, BOARD.size[1] / 2, 0.0])
    pose[:3, 3] = centre - pose[:3, :3] @ middle
    return pose


def surface_places(height: float) -> dict[str, Place]:
    """Where the board lay on the surface: flat, twice."""
    return {
        "surface_a": Place(flat_pose([height + 1e-3, -0.045, 0.0025])),
        "surface_b": Place(flat_pose([height + 1e-3, -0.040, 0.0005])),
    }


def under_places(height: float, sigma: float = 2e-5) -> dict[str, Place]:
    """Where it lay under the surface: deep and flat, and on a wedge."""
    return {
        "under_deep": Place(flat_pose([height - 0.033, -0.045, 0.0025]), True, sigma),
        "under_wedge": Place(
            flat_pose([height - 0.030, -0.045, 0.004], pitch_deg=12.0), True, sigma
        ),
        "under_wedge_b": Place(
            flat_pose([height - 0.006, -0.045, 0.004], pitch_deg=-12.0), True, sigma
        ),
    }


def scatter(pose: Array, sigma: float, rng: np.random.Generator) -> Array:
    """A place as it really is: known to `sigma` only."""
    moved = np.array(pose, dtype=np.float64)
    turn = Rotation.from_rotvec(rng.normal(0.0, 2 * sigma / 0.12, 3))
    moved[:3, :3] = turn.as_matrix() @ pose[:3, :3]
    moved[:3, 3] += rng.normal(0.0, sigma, 3)
    return moved


def take(
    rig: TrueRig,
    rng: np.random.Generator,
    free: int = 20,
    surface: bool = True,
    under: bool = True,
    noise: float = 0.1,
) -> list[BoardView]:
    """Views of a calibration session; places are those the session file says."""
    views = [rig.view(f"free_{i:02d}", free_pose(rng), None, rng, noise) for i in range(free)]
    if surface:
        views += [
            rig.view(n, p.T_rig_board, p, rng, noise) for n, p in surface_places(0.0175).items()
        ]
    if under:
        for name, place in under_places(0.0175).items():
            true = scatter(place.T_rig_board, place.sigma, rng)
            views.append(rig.view(name, true, place, rng, noise))
    return views
