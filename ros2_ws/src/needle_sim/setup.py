"""Install script of needle_sim; colcon calls it."""

from glob import glob

from setuptools import setup

PACKAGE = "needle_sim"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=[PACKAGE, f"{PACKAGE}.drives"],
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
            "sim_rig = needle_sim.sim_rig_node:main",
            "drive_emulator = needle_sim.drive_emulator_node:main",
            "monte_carlo = needle_sim.monte_carlo:main",
            "render_images = needle_sim.render_images:main",
        ]
    },
)
