"""Draws what two cameras would see of a calibration board, held freely and at a session's places.

python docs/examples/draw_board_images.py SESSION NEW_FOLDER

SESSION is a session file (docs/calibration.md), for cameras that look through one level surface.
NEW_FOLDER gets left, right and a copy of it.
"""

import importlib
import shutil
import sys
from pathlib import Path

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import load_session

FREE_VIEWS = 12
TRACKER = Path(__file__).resolve().parents[2] / "ros2_ws" / "src" / "needle_tracker"

if len(sys.argv) != 3:
    sys.exit("usage: python docs/examples/draw_board_images.py SESSION NEW_FOLDER")
given, folder = map(Path, sys.argv[1:])
if folder.exists():
    sys.exit(f"error: {folder} is there already: name another folder, or remove it")
try:
    read = load_session(given)
except UserError as error:
    sys.exit(f"error: {error}")
if not all(place.is_known for place in read.places.values()):
    sys.exit(f"error: session {given}: only places with an origin can be drawn")
# The rig that the calibration is tested on: its rays are not those of the code that calibrates.
sys.path.insert(0, str(TRACKER / "test"))
session = importlib.import_module("calibrating.session")
rig = importlib.import_module("calibrating.synthetic_rig").TrueRig
truth = rig.read(TRACKER / "config" / "calibration.yaml", read.board)
session.record(folder, truth, read.places, free=FREE_VIEWS)
shutil.copy(given, folder / "session.yaml")
print(f"{folder}: left, right, session.yaml")
