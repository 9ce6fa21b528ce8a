"""Execution of the parts of a study, or of another job, on a Dask cluster.

If a worker dies, another one repeats its parts. A worker with different code or other versions of
numerical libraries ends the job, because its results would differ. Every machine of a study also
steers the same few needles, to detect processors that round differently.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import hashlib
import importlib.metadata
import importlib.util
import logging
import pickle
import platform
import re
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from needle_bringup.studies.study_parts import StudyPart
from needle_core.errors import UserError
from needle_sim.studies.figures_of_merit import Outcomes
from needle_sim.studies.point_study import PointOutcomes

Part = TypeVar("Part")
Result = TypeVar("Result")

CONNECTS_WITHIN = 30.0
"""Time limit for the connection to the scheduler [s]."""
_NUMERICAL = ("numpy", "scipy", "numba")
_PACKAGES = (
    "needle_bags", "needle_bringup", "needle_core", "needle_console",
    "needle_controller", "needle_device_driver", "needle_sim", "needle_tracker",
)  # fmt: skip


def on_cluster(
    address: str, work: Callable[[Part], Result], parts: Sequence[Part]
) -> Iterator[Result]:
    """Yield the results of `work` on each part, in the order of the parts.

    Parameters
    ----------
    address : str
        Address of the scheduler, such as tcp://10.0.0.5:8786. The call waits for workers.
    work : callable
        A module-level function, which workers can import.
    parts : sequence
        Arguments that can be pickled.

    Raises
    ------
    UserError
        If the address is invalid, Dask is not installed, the scheduler does not answer or is lost,
        a worker has different code, or a part killed several workers.
    """
    if re.fullmatch(r"(tcp|tls)://[^\s/]+:\d+", address) is None:
        raise UserError(
            f"--scheduler {address!r} is not tcp://HOST:PORT or tls://HOST:PORT, "
            "as the scheduler prints it"
        )
    try:
        # Optional dependency that takes a second to import.
        import distributed  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise UserError(
            "--scheduler: Dask is not installed; scripts/dask --version installs it"
        ) from error
    # Disable its log, because it also raises the logged errors.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    run = functools.partial(_run, work, identity(_package_of(work)))
    try:
        with distributed.Client(address, timeout=CONNECTS_WITHIN) as client:
            futures = collections.deque(client.map(run, parts, pure=False, batch_size=100))
            while futures:
                # Without its future, the cluster frees the result.
                yield futures.popleft().result()
    except distributed.KilledWorker as error:
        raise UserError(
            f"--scheduler {address}: {_line(error)} (out of memory? see their logs)"
        ) from error
    except (OSError, distributed.CancelledError) as error:
        raise UserError(f"--scheduler {address}: {_line(error)}") from error


@functools.lru_cache(maxsize=1)
def identity(package_of_work: str) -> Mapping[str, str]:
    """Return the library versions and a digest of the rig's code and the package of the work."""
    code = hashlib.sha256()
    for package in sorted({*_PACKAGES, package_of_work}):
        spec = importlib.util.find_spec(package)
        for place in spec.submodule_search_locations or () if spec is not None else ():
            for module in sorted(Path(place).rglob("*.py")):
                code.update(f"{package}/{module.relative_to(place)}\n".encode())
                code.update(module.read_bytes())
    versions = {name: importlib.metadata.version(name) for name in _NUMERICAL}
    python = ".".join(platform.python_version_tuple()[:2])
    return {"python": python, **versions, "code": code.hexdigest()[:12]}


def _package_of(work: Callable[[Part], Result]) -> str:
    return work.__module__.partition(".")[0]


def _run(work: Callable[[Part], Result], expected: Mapping[str, str], part: Part) -> Result:
    """Run a part on a worker."""
    here = identity(_package_of(work))
    differing = [
        f"{name} {here[name]} instead of {expected[name]}"
        for name in expected
        if here[name] != expected[name]
    ]
    if differing:
        raise UserError(
            f"the worker on {socket.gethostname()} has {', '.join(differing)}; all machines need "
            "the same checkout, set up alike (docs/several_computers.md)"
        )
    return work(part)


def _line(error: BaseException) -> str:
    """Return the text of an exception as one line."""
    return " ".join(str(error).split())


# ---- studies ----------------------------------------------------------------------------------


class ClusterPart(NamedTuple):
    """Part of a study that any machine can run.

    Attributes
    ----------
    part : StudyPart
        The part of the study.
    witness : StudyPart
        A few needles that every machine steers, to compare the results bit by bit.
    """

    part: StudyPart
    witness: StudyPart


class PartDone(NamedTuple):
    """Result of a part.

    Attributes
    ----------
    outcomes : Outcomes or PointOutcomes
        Outcomes of its needles.
    cpu_s : float
        Processor time [s].
    machine : str
        Name of the machine.
    witness : str
        Digest of the outcomes of the witness on that machine.
    """

    outcomes: Outcomes | PointOutcomes
    cpu_s: float
    machine: str
    witness: str


def run_parts(
    address: str, parts: Sequence[StudyPart], witness: StudyPart, on_progress: Callable[[int], None]
) -> tuple[list[Outcomes | PointOutcomes], float, list[str]]:
    """Steer the needles of all parts on the cluster of a scheduler.

    Parameters
    ----------
    address : str
        Address of the scheduler.
    parts : sequence of StudyPart
        The parts of the study.
    witness : StudyPart
        A few needles, steered here as well.
    on_progress : callable
        Called after each part with its number of needles.

    Returns
    -------
    outcomes : list of Outcomes or PointOutcomes
        Outcomes, in the order of the parts.
    cpu_s : float
        Total processor time of the parts [s].
    differing : list of str
        Machines that round differently from this one.

    Raises
    ------
    UserError
        For the same reasons as `on_cluster`.
    """
    asked = [ClusterPart(part, witness) for part in parts]
    done = []
    for part, result in zip(parts, on_cluster(address, run_part, asked), strict=True):
        done.append(result)
        on_progress(len(part.starts))
    expected = digest(witness.run())
    differing = sorted({part.machine for part in done if part.witness != expected})
    return [part.outcomes for part in done], sum(part.cpu_s for part in done), differing


def run_part(asked: ClusterPart) -> PartDone:
    """Run a part on a worker."""
    witness = _witness_digest(pickle.dumps(asked.witness))
    begin = time.thread_time()
    outcomes = asked.part.run()
    return PartDone(outcomes, time.thread_time() - begin, socket.gethostname(), witness)


@functools.lru_cache(maxsize=4)
def _witness_digest(pickled: bytes) -> str:
    """Return the digest of the outcomes of a witness, computed once in each process."""
    witness: StudyPart = pickle.loads(pickled)
    return digest(witness.run())


def digest(outcomes: Outcomes | PointOutcomes) -> str:
    """Return a digest of all bits of the outcomes."""
    total = hashlib.sha256()
    for field in dataclasses.fields(outcomes):
        total.update(np.ascontiguousarray(getattr(outcomes, field.name)).tobytes())
    return total.hexdigest()
