"""scripts/env.sh, sourced in a separate checkout whose path has a space."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
SHELLS = [
    pytest.param(shell, marks=pytest.mark.skipif(not shutil.which(shell), reason=f"no {shell}"))
    for shell in ("bash", "zsh")
]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    root = tmp_path / "with a space"
    (root / "scripts").mkdir(parents=True)
    shutil.copy(SCRIPTS / "env.sh", root / "scripts")
    return root


@pytest.fixture
def set_up(checkout: Path) -> Path:
    (checkout / ".venv").mkdir()
    (checkout / ".venv" / ".needle-setup").write_text("wheels key key\n")
    for name in ("needle_one", "needle_two"):
        (checkout / "ros2_ws/install" / name / "share").mkdir(parents=True)
    return checkout


def shell(name: str, text: str, **variables: str) -> subprocess.CompletedProcess[str]:
    env = {"PATH": os.environ["PATH"], "HOME": "/nonexistent", **variables}
    return subprocess.run(
        [name, "-c", text], check=False, env=env, text=True, capture_output=True, cwd="/"
    )


def sourced(name: str, root: Path, times: int = 1, **variables: str) -> dict[str, str]:
    source = f". {str(root / 'scripts' / 'env.sh')!r}; "
    line = f"set -eu; {source * times} env -0"
    result = shell(name, line, **variables)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    return dict(item.split("=", 1) for item in result.stdout.split("\0") if "=" in item)


@pytest.mark.parametrize("name", SHELLS)
def test_sets_the_environment_under_strict_options_from_any_folder(name: str, set_up: Path) -> None:
    before = {"LD_LIBRARY_PATH": "/elsewhere", "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}
    env = sourced(name, set_up, 1, **before)
    # A second call changes nothing.
    assert {**sourced(name, set_up, times=2, **before), "_": ""} == {**env, "_": ""}
    assert env["PATH"].split(":")[0] == str(set_up / ".venv/bin")
    assert env["AMENT_PREFIX_PATH"] == str(set_up / ".venv")
    assert env["ROS_PYTHON_CHECK_FIELDS"] == "1"
    assert env["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert env["RMW_IMPLEMENTATION"] == "rmw_fastrtps_cpp"
    assert env["FASTRTPS_DEFAULT_PROFILES_FILE"].endswith("/needle_fastdds.xml")
    assert "LD_LIBRARY_PATH" not in env
    assert "_ROS_WHEELS_BOOTSTRAP_COMPLETE" not in env
    assert "ROS_DOMAIN_ID" not in env


@pytest.mark.parametrize("name", SHELLS)
def test_settings_of_the_user_are_kept(name: str, set_up: Path) -> None:
    env = sourced(
        name,
        set_up,
        ROS_DOMAIN_ID="42",
        ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET",
        PYTHONPATH="/mine:/too",
    )
    assert env["ROS_DOMAIN_ID"] == "42"
    assert env["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SUBNET"
    assert env["FASTRTPS_DEFAULT_PROFILES_FILE"].endswith("/needle_fastdds_network.xml")
    assert env["PYTHONPATH"] == "/mine:/too"


@pytest.mark.parametrize("name", SHELLS)
def test_another_middleware_is_named_and_replaced(name: str, set_up: Path) -> None:
    source = f". {str(set_up / 'scripts' / 'env.sh')!r}"
    line = f"set -eu; {source}; {source}; echo $RMW_IMPLEMENTATION"
    result = shell(name, line, RMW_IMPLEMENTATION="rmw_cyclonedds_cpp")
    assert result.stdout == "rmw_fastrtps_cpp\n"
    assert result.stderr == (
        "env.sh: RMW_IMPLEMENTATION=rmw_cyclonedds_cpp ignored: "
        "the rig's nodes run on rmw_fastrtps_cpp\n"
    )


@pytest.mark.parametrize("name", SHELLS)
def test_a_missing_set_up_gives_one_line(name: str, checkout: Path) -> None:
    result = shell(name, f". {str(checkout / 'scripts/env.sh')!r} || echo code $?")
    assert result.stdout == "code 1\n"
    assert result.stderr.splitlines() == [
        f"env.sh: this checkout is not set up, or only in part: run {checkout / 'scripts/setup'}"
    ]


def test_paths_of_ros_come_after_ours(set_up: Path) -> None:
    (set_up / ".venv" / ".needle-setup").write_text("apt key key\n")
    env = sourced(
        "bash",
        set_up,
        ROS_DISTRO="jazzy",
        AMENT_PREFIX_PATH="/opt/ros/jazzy",
        LD_LIBRARY_PATH="/opt/ros/jazzy/lib",
    )
    ours = [str(set_up / "ros2_ws/install" / name) for name in ("needle_two", "needle_one")]
    assert env["AMENT_PREFIX_PATH"] == ":".join([*ours, "/opt/ros/jazzy"])
    assert env["LD_LIBRARY_PATH"] == "/opt/ros/jazzy/lib"
    result = shell("bash", f". {str(set_up / 'scripts/env.sh')!r}")
    assert result.returncode == 1
    assert "source its setup.bash first" in result.stderr
