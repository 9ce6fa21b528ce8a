"""A study's parts on a Dask cluster, and whether its machines reckon as this one does."""

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
    """A part to be done on whichever machine.

    Attributes
    ----------
    part : StudyPart
        What is asked for.
    witness : StudyPart
        A few needles that every machine steers, so that their last bits can be compared.
    """

    part: StudyPart
    witness: StudyPart


@dataclasses.dataclass(frozen=True)
class PartDone:
    """Result of a part.

    Attributes
    ----------
    outcomes : Outcomes or PointOutcomes
        Of its needles.
    cpu_s : float
        What it cost [s].
    machine : str
        Who did it.
    witness : str
        Digest of the witness's outcomes on that machine.
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
        The scheduler's.
    parts : sequence of StudyPart
        The study.
    witness : StudyPart
        A few needles, steered here as well.
    on_progress : callable
        Told after each part how many needles it had.

    Returns
    -------
    outcomes : list of Outcomes or PointOutcomes
        In the order of the parts.
    cpu_s : float
        What they cost together [s].
    differing : list of str
        Machines that round otherwise than this one does.

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
    """Do a part, on a worker."""
    witness = _witness_digest(pickle.dumps(asked.witness))
    begin = time.thread_time()
    outcomes = asked.part.run()
    return PartDone(outcomes, time.thread_time() - begin, socket.gethostname(), witness)


@functools.lru_cache(maxsize=4)
def _witness_digest(pickled: bytes) -> str:
    """Return the digest of a witness's outcomes; once for each process."""
    witness: StudyPart = pickle.loads(pickled)
    return digest(witness.run())


def digest(outcomes: Outcomes | PointOutcomes) -> str:
    """Return a digest of all bits of some outcomes."""
    total = hashlib.sha256()
    for field in dataclasses.fields(outcomes):
        total.update(np.ascontiguousarray(getattr(outcomes, field.name)).tobytes())
    return total.hexdigest()
