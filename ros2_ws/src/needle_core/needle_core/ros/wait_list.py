"""An executor that gathers what it waits for once, not before every callback.

rclpy's own asks every entity of its nodes anew, two or three times a callback: of nodes like these
0.2 ms each time, most of what an idle one does (its issue 1389). Its experimental EventsExecutor
would do without, but tells nobody whose message could not be read, and keeps another order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Coroutine, Iterable, Iterator
from contextlib import ExitStack, suppress
from typing import Any

from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import (
    ConditionReachedException,
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.task import Task
from rclpy.utilities import timeout_sec_to_nsec
from rclpy.waitable import NumberOfEntities

Execution = Callable[[], Coroutine[Any, Any, None]]
"""Runs a callback on what was taken for it."""
Take = Callable[[Any], Execution | None]
"""Takes what is there for an entity; None where nothing is."""


class WaitListExecutor(SingleThreadedExecutor):
    """rclpy's executor of one thread, in the same order, at a fraction of its cost.

    Parameters
    ----------
    context : Context, optional
        Where its nodes live; the global context by default.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        self._list: _WaitList | None = None
        self._is_stale = False
        self._tasks: list[tuple[Task[Any], Any, Node]]
        super().__init__(context=context)

    def add_node(self, node: Node) -> bool:
        """Run a node's callbacks; return whether it is new."""
        self._is_stale = True
        return bool(super().add_node(node))

    def remove_node(self, node: Node) -> None:
        """Run a node's callbacks no longer."""
        self._is_stale = True
        super().remove_node(node)

    def wake(self) -> None:
        """Take note, from whatever thread, that entities of a node came or went."""
        self._is_stale = True
        super().wake()

    def _run_ready(self, timeout_sec: float) -> bool:
        """Run what one look finds; return whether it found anything."""
        found = False
        with suppress(ShutdownException, TimeoutException):
            for task, *_ in self._wait_for_ready_callbacks(timeout_sec):
                found = True
                task()
                # Raises what the callback raised.
                task.result()
        return found

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Run no callback any more."""
        self._let_go()
        return bool(super().shutdown(timeout_sec))

    def _let_go(self) -> None:
        if self._list is not None:
            self._list.close()
        self._list = None

    def _make_handler(self, entity: Any, node: Node, take_from_wait_list: Take) -> Task[Any]:
        async def run() -> None:
            group = entity.callback_group
            if self._is_shutdown or not group.beginning_execution(entity):
                return
            try:
                execute = take_from_wait_list(entity)
                if execute is not None:
                    await execute()
            finally:
                group.ending_execution(entity)

        task: Task[Any] = Task(run, executor=self)
        with self._tasks_lock:
            self._tasks.append((task, entity, node))
        return task

    def _wait_for_ready_callbacks(
        self,
        timeout_sec: Any = None,
        nodes: None = None,
        condition: Callable[[], bool] = lambda: False,
    ) -> Iterator[tuple[Task[Any], Any, Node]]:
        """Yield what is ready, as rclpy's own does; a look that yielded something is the last."""
        timeout_ns = int(timeout_sec_to_nsec(getattr(timeout_sec, "timeout", timeout_sec)))
        until_ns = time.monotonic_ns() + timeout_ns
        left_ns = timeout_ns
        yielded = False
        while not (yielded or self._is_shutdown or condition()):
            for begun in self._begun_tasks():
                yielded = True
                yield begun
            ready = self._wait(left_ns)
            if timeout_ns > 0:
                left_ns = max(until_ns - time.monotonic_ns(), 0)
            for entity, node, take in ready:
                if entity.callback_group.can_execute(entity):
                    yielded = True
                    yield self._make_handler(entity, node, take), entity, node
            if left_ns == 0:
                raise TimeoutException
        if self._is_shutdown:
            raise ShutdownException
        if condition():
            raise ConditionReachedException

    def _begun_tasks(self) -> Iterator[tuple[Task[Any], Any, Node]]:
        """Yield tasks that were begun or ordered and are not done; forget those that are."""
        with self._tasks_lock:
            tasks = list(self._tasks)
        for begun in reversed(tasks):
            if not (begun[0].executing() or begun[0].done()):
                yield begun
        with self._tasks_lock:
            self._tasks = [
                each for each in self._tasks if not (each[0].done() or each[0].cancelled())
            ]

    def _wait(self, timeout_ns: int) -> Iterable[tuple[Any, Node, Take]]:
        """Return what becomes ready in this time [ns], of each its node and how it is taken."""
        if self._is_stale or self._list is None:
            # Not afterwards: what comes meanwhile makes it stale again.
            self._is_stale = False
            self._let_go()
            self._list = _WaitList(self)
        ready = self._list.wait(timeout_ns)
        if self._is_shutdown:
            raise ShutdownException
        if not self.context.ok():
            raise ExternalShutdownException
        return ready


class _WaitList:
    """All that an executor waits for, held until it is closed.

    Parameters
    ----------
    executor : WaitListExecutor
        Whose nodes.
    """

    def __init__(self, executor: WaitListExecutor) -> None:
        self._held = ExitStack()
        self._guards = [executor._guard.handle, executor._sigint_gc.handle]
        for handle in (executor.context.handle, *self._guards):
            self._held.enter_context(handle)
        self._waitables: list[tuple[Any, Node, Take]] = []
        self._entities: list[tuple[str, Any, Node, Take]] = []
        counts = NumberOfEntities(num_gcs=len(self._guards))
        for node in executor.get_nodes():
            for waitable in filter(self._holds, node.waitables):
                self._waitables.append((waitable, node, executor._take_waitable))
                counts += waitable.get_num_entities()
            # In this order they have their turn.
            for kind, entities, take in (
                ("timer", node.timers, executor._take_timer),
                ("subscription", node.subscriptions, executor._take_subscription),
                ("guard_condition", node.guards, executor._take_guard_condition),
                ("client", node.clients, executor._take_client),
                ("service", node.services, executor._take_service),
            ):
                held = [entity for entity in entities if self._holds(entity.handle)]
                self._entities += [(kind, entity, node, take) for entity in held]
        kinds = ("subscription", "guard_condition", "timer", "client", "service")
        self._node_guards = [each for kind, each, *_ in self._entities if kind == kinds[1]]
        self._handles = {
            kind: [entity.handle for of, entity, *_ in self._entities if of == kind]
            for kind in kinds
        }
        counts += NumberOfEntities(*(len(self._handles[kind]) for kind in kinds))
        self._wait_set = rclpy_implementation.WaitSet(
            counts.num_subscriptions,
            counts.num_guard_conditions,
            counts.num_timers,
            counts.num_clients,
            counts.num_services,
            counts.num_events,
            executor.context.handle,
        )

    def wait(self, timeout_ns: int) -> Iterator[tuple[Any, Node, Take]]:
        """Wait for so long [ns], for ever if negative; yield what was ready then, in its turn."""
        wait_set, handles = self._wait_set, self._handles
        for guard in self._node_guards:
            if guard._executor_triggered:
                # Its turn has not come yet, and what was waited for is forgotten.
                guard.trigger()
        wait_set.clear_entities()
        for kind, of_kind in handles.items():
            add = getattr(wait_set, f"add_{kind}")
            for handle in of_kind:
                add(handle)
        for handle in self._guards:
            wait_set.add_guard_condition(handle)
        for waitable, *_ in self._waitables:
            waitable.add_to_wait_set(wait_set)
        wait_set.wait(timeout_ns)
        ready = {kind: set(wait_set.get_ready_entities(kind)) for kind in handles}
        told = [each for each in self._waitables if each[0].is_ready(wait_set)]
        for guard in self._node_guards:
            guard._executor_triggered |= guard.handle.pointer in ready["guard_condition"]
        return self._in_turn(told, ready)

    def _in_turn(
        self, told: list[tuple[Any, Node, Take]], ready: dict[str, set[int]]
    ) -> Iterator[tuple[Any, Node, Take]]:
        yield from told
        for kind, entity, node, take in self._entities:
            if entity.handle.pointer not in ready[kind]:
                continue
            # One that was cancelled by a callback before it is none any more.
            if kind != "timer" or entity.handle.is_timer_ready():
                yield entity, node, take

    def close(self) -> None:
        """Let go of what is held."""
        self._held.close()

    def _holds(self, entity: Any) -> bool:
        """Return whether an entity could be held; one that is gone cannot."""
        try:
            self._held.enter_context(entity)
        except InvalidHandle:
            return False
        return True
