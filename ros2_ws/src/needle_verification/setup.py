"""Install script of needle_verification; colcon calls it."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "needle_verification"

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
    description="What the rig's software must be able to show; no rig needs it.",
    license="Apache-2.0",
    entry_points={"console_scripts": []},
)
