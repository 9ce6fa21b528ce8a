"""The rig, and needles to draw for its tracker."""

from __future__ import annotations

from tracker_fixtures import calibration, calibration_path, settings, views

__all__ = ["calibration", "calibration_path", "settings", "views"]
