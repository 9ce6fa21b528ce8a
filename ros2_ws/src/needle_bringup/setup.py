"""Install script of needle_bringup; colcon calls it."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "needle_bringup"

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
    description="The rig as a whole: operator, simulate, launch files, configuration.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "operator = needle_bringup.executables:operator",
        ]
    },
)
