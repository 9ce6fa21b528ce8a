"""Install script of needle_tracker; colcon calls it."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "needle_tracker"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed", "image/needle_map.onnx"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", glob("config/*")),
        (f"share/{PACKAGE}/launch", glob("launch/*.py")),
    ],
    zip_safe=False,
    maintainer="Needle steering maintainers",
    maintainer_email="maintainers@needle-steering.invalid",
    description="Stereo images to the needle's tip, through the phantom's refracting surface.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "stereo_tracker = needle_tracker.executables:stereo_tracker",
            "track_images = needle_tracker.executables:track_images",
            "calibrate_stereo = needle_tracker.executables:calibrate_stereo",
            "check_calibration = needle_tracker.executables:check_calibration",
            "stereo_camera = needle_tracker.executables:stereo_camera",
        ]
    },
)
