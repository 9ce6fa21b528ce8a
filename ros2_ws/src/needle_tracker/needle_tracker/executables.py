"""The package's executables."""

from needle_common.executables import command, node

stereo_tracker = node("needle_tracker.stereo_tracker_node")
track_images = command("needle_tracker.track_images")
calibrate_stereo = command("needle_tracker.calibrate_stereo")
check_calibration = command("needle_tracker.check_calibration_node")
stereo_camera = node("needle_tracker.stereo_camera_node")
