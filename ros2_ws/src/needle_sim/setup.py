"""Install script of needle_sim; colcon calls it."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "needle_sim"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", glob("config/*")),
        (f"share/{PACKAGE}/launch", glob("launch/*.py")),
    ],
    zip_safe=False,
    maintainer="Needle steering maintainers",
    maintainer_email="maintainers@needle-steering.invalid",
    description="Stands in for the rig: needle plant, tissue, stereo renderer, emulated drives.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "sim_rig = needle_sim.executables:sim_rig",
            "drive_emulator = needle_sim.executables:drive_emulator",
            "monte_carlo = needle_sim.executables:monte_carlo",
            "render_images = needle_sim.executables:render_images",
        ]
    },
)
