"""The fixtures of tests of the tracker."""

from __future__ import annotations

from tracker_fixtures import calibration, calibration_path, draw_pair, settings, views

__all__ = ["calibration", "calibration_path", "draw_pair", "settings", "views"]
