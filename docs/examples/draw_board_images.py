"""Draws what two cameras would see of a calibration board: images for a first calibration.

python docs/examples/draw_board_images.py FOLDER
"""

import importlib
import sys
from pathlib import Path

import yaml

from needle_tracker.calibrating.calibration_session import parse_session

FREE_VIEWS = 12
TRACKER = Path(__file__).resolve().parents[2] / "ros2_ws" / "src" / "needle_tracker"
SESSION = """\
board: {columns: 12, rows: 9, square: 0.010, marker: 0.0075, dictionary: DICT_5X5_100}
phantom: {surface_height: 0.0175, refractive_index: 1.33}
places:
  surface_near: {origin: [0.0185, -0.045, 0.0025]}
  surface_far: {origin: [0.0185, -0.045, 0.0125]}
  under_wedge:
    origin: [-0.0125, -0.045, 0.004]
    columns: [0.2079, 0, 0.9781]
    rows: [0, 1, 0]
    under_surface: true
    sigma: 2.0e-5
"""

if len(sys.argv) != 2 or Path(sys.argv[1]).exists():
    sys.exit("usage: python docs/examples/draw_board_images.py NEW_FOLDER")
folder = Path(sys.argv[1])
# The rig that the calibration is tested on: its rays are not those of the code that calibrates.
sys.path.insert(0, str(TRACKER / "test"))
session = importlib.import_module("calibrating.session")
rig = importlib.import_module("calibrating.synthetic_rig").TrueRig
truth = rig.read(TRACKER / "config" / "calibration.yaml")
session.record(folder, truth, parse_session(yaml.safe_load(SESSION)).places, free=FREE_VIEWS)
(folder / "session.yaml").write_text(SESSION, encoding="utf-8")
print(f"{folder}: left, right, session.yaml")
