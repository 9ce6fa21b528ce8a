"""Runs the parts of a study on a Dask cluster, and checks that its machines round alike."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import pickle
import socket
import time
from collections.abc import Callable, Sequence

import numpy as np

from needle_bringup.studies.cluster import on_cluster
from needle_bringup.studies.study_parts import StudyPart
from needle_sim.studies.figures_of_merit import Outcomes
from needle_sim.studies.point_study import PointOutcomes


@dataclasses.dataclass(frozen=True)
class ClusterPart:
    """A part to run on any machine.

    Attributes
    ----------
    part : StudyPart
        The part of the study.
    witness : StudyPart
        A few needles that every machine steers, to compare their last bits.
    """

    part: StudyPart
    witness: StudyPart


@dataclasses.dataclass(frozen=True)
class PartDone:
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
    address: str,
    parts: Sequence[StudyPart],
    witness: StudyPart,
    on_progress: Callable[[int], None],
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
        In the order of the parts.
    cpu_s : float
        Their total processor time [s].
    differing : list of str
        Machines that round differently from this one.

    Raises
    ------
    UserError
        As of `cluster.on_cluster`.
    """
    asked = [ClusterPart(part, witness) for part in parts]
    done = []
    for part, result in zip(parts, on_cluster(address, run_part, asked), strict=True):
        done.append(result)
        on_progress(len(part.starts))
    wanted = digest(witness.run())
    differing = sorted({part.machine for part in done if part.witness != wanted})
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
