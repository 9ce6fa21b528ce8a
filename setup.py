"""Install script of the rig as one distribution: all that colcon installs package by package."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT / "ros2_ws" / "src" / "needle_core"))

from package_setup import set_up_all

set_up_all(ROOT)
