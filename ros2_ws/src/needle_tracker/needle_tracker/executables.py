"""The package's executables."""

from needle_core.commands.executables import command, node

stereo_tracker = node("needle_tracker.ros.stereo_tracker")
track_images = command("needle_tracker.answers.track_images")
calibrate_stereo = command("needle_tracker.calibrating.calibrate_stereo")
check_calibration = command("needle_tracker.ros.check_calibration")
stereo_camera = node("needle_tracker.ros.stereo_camera")
tracked_tip = node("needle_tracker.ros.tracked_tip")
register_tracker = command("needle_tracker.tracked.register_tracker")
