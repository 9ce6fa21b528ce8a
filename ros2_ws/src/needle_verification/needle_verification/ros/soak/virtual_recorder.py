"""The rig's recorder on a virtual graph and disk, and what its bags must hold."""

from __future__ import annotations

import contextlib
import io
from collections import Counter
from collections.abc import Callable
from typing import Any

from needle_bags.ros.recorder import Recorder
from needle_verification.ros.soak.virtual_endpoint import Sample
from needle_verification.ros.soak.virtual_topics import VirtualGraph
from needle_verification.soak.faults import RECORDER
from needle_verification.soak.judging.bag_witness import BagWitness
from needle_verification.soak.virtual_disk import DiskUser, VirtualDisk
from needle_verification.soak.virtual_world import VirtualProcess

_NAME = f"/{RECORDER}"


class VirtualRecorders:
    """The recorders of one rig, one after the other, each with a bag on the same disk.

    Parameters
    ----------
    graph : VirtualGraph
        What they record.

    Attributes
    ----------
    disk : VirtualDisk
        Where they do.
    """

    def __init__(self, graph: VirtualGraph) -> None:
        self._graph = graph
        self.disk = VirtualDisk()
        self._all: list[_Recorder] = []

    def plan(self, process: VirtualProcess) -> tuple[dict[str, Any], Callable[[], Recorder]]:
        """Return the parameters of the next one, and what makes it."""
        bag = self.disk.next_bag()
        one = _Recorder(DiskUser(self.disk, process), BagWitness(bag, self._overflows()))
        self._all.append(one)
        world = self._graph.world

        def hear(topic: str, sample: Sample) -> None:
            one.witness.take(world.steady_ns, topic, sample.sent_ns, sample.number)

        self._graph.listen_at(_NAME, hear)
        return {"bag": str(bag)}, one.make

    @property
    def bytes_waiting(self) -> int:
        """Size of what waits for the disk [B]."""
        recordings = [one.user.recording for one in self._all if one.runs]
        return sum(one.bytes_waiting for one in recordings if one is not None)

    def end(self, *, judges_killed: bool) -> list[str]:
        """End the one that runs, as after SIGINT; return what the bags lack.

        Parameters
        ----------
        judges_killed : bool
            Whether the bags of killed ones count: nothing else kept them from writing.
        """
        losses = []
        for one in self._all:
            if one.runs:
                why = one.finish()
                losses += [why] if why else one.witness.losses_of_ended(self._overflows())
            elif one.killed_ns is not None and judges_killed:
                losses += one.witness.losses_of_killed(one.killed_ns)
        return losses

    def close(self) -> None:
        """Remove the disk."""
        self.disk.close()

    def _overflows(self) -> Counter[str]:
        """Return how many messages a recorder's queues had no room for, by topic."""
        all_of = self._graph.overflows
        return Counter({topic: n for (node, topic), n in all_of.items() if node == _NAME})


class _Recorder:
    """A recorder from its start to its end."""

    def __init__(self, user: DiskUser, witness: BagWitness) -> None:
        self.user = user
        self.witness = witness
        self.killed_ns: int | None = None
        self._node: Recorder | None = None

    @property
    def runs(self) -> bool:
        return self._node is not None

    def make(self) -> Recorder:
        node = self._node = Recorder(self.user.open_recording)

        def end() -> None:
            if self.runs:
                self._node, self.killed_ns = None, self.user.process.world.steady_ns
            self.user.cut()

        node.context.on_shutdown(end)
        return node

    def finish(self) -> str:
        """End it; return why its bag is not whole, empty where it is."""
        node, self._node = self._node, None
        assert node is not None
        # What it says of it is for the person who ran it.
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            node.finish()
        node.context.shutdown()
        recording = node.recording
        return "" if recording.is_whole else f"{node.bag} is not whole: {recording.error}"
