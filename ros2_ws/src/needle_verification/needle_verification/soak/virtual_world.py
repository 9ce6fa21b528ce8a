"""A world of processes in one thread: one clock, events in their order, waits that go on."""

from __future__ import annotations

import contextlib
import heapq
import random
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from needle_core.errors import UserError

NANOSECONDS = 1_000_000_000
# Readings of the two clocks when a world begins [ns].
STEADY_START_NS = 1_000 * NANOSECONDS
SYSTEM_START_NS = 1_750_000_000 * NANOSECONDS
# What a callback takes of its process' time [ns], at least and at most.
_CALLBACK_NS = (20_000, 200_000)


class VirtualWorld:
    """Events of all processes, one after the other.

    Those that are due at the same time come in the order in which they were planned.

    Parameters
    ----------
    seed : int
        Of all that is drawn in this world.

    Attributes
    ----------
    steady_ns : int
        The steady clock [ns].
    system_offset_ns : int
        What the system clock is ahead of where it would be without jumps [ns].
    crashes : list of tuple of str
        Processes that ended by an error that nothing foresaw, and the error.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._chances: dict[tuple[str, ...], random.Random] = {}
        self.steady_ns = STEADY_START_NS
        self.system_offset_ns = 0
        self.crashes: list[tuple[str, str]] = []
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0

    @property
    def steady(self) -> float:
        """The steady clock [s]."""
        return self.steady_ns / NANOSECONDS

    @property
    def system_ns(self) -> int:
        """The system clock [ns]."""
        return SYSTEM_START_NS + self.steady_ns - STEADY_START_NS + self.system_offset_ns

    def chance(self, *what: str) -> random.Random:
        """Return what draws for one thing, named by its words.

        Each has a sequence of its own, so a draw more or less for one shifts nothing of another.
        """
        chance = self._chances.get(what)
        if chance is None:
            chance = self._chances[what] = random.Random(f"{self._seed} {' | '.join(what)}")
        return chance

    def call_at(self, due_ns: int, action: Callable[[], None]) -> None:
        """Call `action` when the steady clock shows `due_ns` [ns], or next where that is past."""
        self._count += 1
        heapq.heappush(self._events, (max(due_ns, self.steady_ns), self._count, action))

    def call_after(self, delay_ns: int, action: Callable[[], None]) -> None:
        """Call `action` after `delay_ns` [ns]."""
        self.call_at(self.steady_ns + delay_ns, action)

    def run_until(self, end_ns: int, predicate: Callable[[], Any] = lambda: False) -> bool:
        """Run all that is due by `end_ns` [ns], or until `predicate` holds.

        Returns
        -------
        bool
            Whether it holds; the clock then shows when, else `end_ns`.
        """
        while not predicate():
            if not self._events or self._events[0][0] > end_ns:
                self.steady_ns = max(self.steady_ns, end_ns)
                return bool(predicate())
            due_ns, _, action = heapq.heappop(self._events)
            self.steady_ns = max(self.steady_ns, due_ns)
            action()
        return True

    @contextlib.contextmanager
    def own_clocks(self) -> Iterator[None]:
        """Make `time.monotonic`, `time.time` and `time.time_ns` read this world's clocks.

        Other threads, such as those of a worker of a cluster, go on to read the real ones.
        """
        before = time.monotonic, time.time, time.time_ns
        real_monotonic, real_time, real_time_ns = before
        this, thread = threading.get_ident(), threading.get_ident

        time.monotonic = lambda: self.steady if thread() == this else real_monotonic()
        time.time = lambda: self.system_ns / NANOSECONDS if thread() == this else real_time()
        time.time_ns = lambda: self.system_ns if thread() == this else real_time_ns()
        try:
            yield
        finally:
            time.monotonic, time.time, time.time_ns = before


class ProcessGoneError(BaseException):
    """Unwinds what a process was doing when it was killed; nothing in it may catch this."""


class VirtualProcess:
    """A process with one thread: what is ready is done one after the other, in a seeded order.

    Parameters
    ----------
    world : VirtualWorld
        Where it runs.
    name : str
        What it is called.
    on_end : callable
        Called once when it has ended by itself: with why, empty where it was wanted.

    Attributes
    ----------
    alive : bool
        Whether it runs; what has ended never does anything again.
    started_ns : int
        When it began, steady clock [ns].
    slowness_ns : int
        What each callback takes longer than usual [ns].
    """

    def __init__(self, world: VirtualWorld, name: str, on_end: Callable[[str], None]) -> None:
        self.world = world
        self.name = name
        self.alive = True
        self.started_ns = world.steady_ns
        self.slowness_ns = 0
        self._on_end = on_end
        self._chance = world.chance("process", name)
        self._ready: list[Callable[[], None]] = []
        self._stopped = False
        self._held: list[Callable[[], None]] = []
        self._busy = False
        self._turn_due = False

    @property
    def stands_still(self) -> bool:
        """Whether it was stopped."""
        return self._stopped

    def do(self, action: Callable[[], None]) -> None:
        """Queue `action` for the process."""
        if self.alive:
            self._ready.append(action)
            self._plan_turn(0)

    def stop(self) -> None:
        """Stand still, as after SIGSTOP."""
        self._stopped = True

    def resume(self) -> None:
        """Go on, as after SIGCONT."""
        self._stopped = False
        held, self._held = self._held, []
        for action in held:
            action()
        self._plan_turn(0)

    def do_concurrently(self, action: Callable[[], None]) -> None:
        """Do `action` at once, as another thread would; while it stands still, when it goes on."""
        if not self.alive:
            return
        if self._stopped:
            self._held.append(action)
        else:
            action()

    def kill(self) -> None:
        """End at once, as after SIGKILL."""
        self.alive = False
        self._ready.clear()

    def wait_for(self, predicate: Callable[[], Any], timeout: float | None) -> bool:
        """Wait inside a callback, at most `timeout` [s], while the others go on."""
        limit = NANOSECONDS * 3600 if timeout is None else round(timeout * NANOSECONDS)
        deadline_ns = self.world.steady_ns + limit
        held = self.world.run_until(deadline_ns, predicate)
        # Who stands still does not see that it could go on.
        if self._stopped and self.alive:
            far_ns = self.world.steady_ns + 3600 * NANOSECONDS
            self.world.run_until(far_ns, lambda: not (self._stopped and self.alive))
            held = bool(predicate())
        if not self.alive:
            raise ProcessGoneError(self.name)
        return held

    def _plan_turn(self, delay_ns: int) -> None:
        if not self._turn_due and self._ready and not self._busy and not self._stopped:
            self._turn_due = True
            self.world.call_after(delay_ns, self._turn)

    def _turn(self) -> None:
        self._turn_due = False
        if not self.alive or self._stopped or self._busy or not self._ready:
            return
        action = self._ready.pop(self._chance.randrange(len(self._ready)))
        self._busy = True
        try:
            action()
        except UserError as error:
            # What is meant to end a node, wherever it is raised.
            self.kill()
            self._on_end(str(error))
        except ProcessGoneError:
            return
        except Exception as error:  # noqa: BLE001 - whatever ends a node
            # The end of a process that nobody meant to end.
            self.world.crashes.append((self.name, f"{type(error).__name__}: {error}"))
            self.kill()
            self._on_end(str(error))
        finally:
            self._busy = False
        self._plan_turn(self._chance.randint(*_CALLBACK_NS) + self.slowness_ns)
