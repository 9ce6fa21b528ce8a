"""Install script of needle_tracker; colcon calls it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "needle_core"))

from package_setup import set_up

set_up(__file__)
