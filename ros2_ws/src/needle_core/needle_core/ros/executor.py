"""Runs a node's callbacks so that nothing that comes from outside ends it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.client import Client
from rclpy.executors import ExternalShutdownException, ShutdownException
from rclpy.node import Node
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.task import Task

from needle_core.errors import UserError
from needle_core.ros.wait_list import Execution, Take, WaitListExecutor

# What is meant to end a node, wherever it is raised.
_ENDS = (UserError, ExternalShutdownException, ShutdownException)


class NodeExecutor(WaitListExecutor):
    """Runs the callbacks of one node; a message or request that one fails on is refused by name.

    What a timer raises ends the node, as ever: it came from within. So does a `UserError`.

    Parameters
    ----------
    node : Node
        Whose callbacks.
    refuse : callable
        Takes topic or service, the kind of trouble, and what is wrong.
    on_failure : callable
        Called with the trouble when a callback of the node's own failed.
    """

    def __init__(
        self,
        node: Node,
        refuse: Callable[[str, str, str], None],
        on_failure: Callable[[str], None],
    ) -> None:
        super().__init__(context=node.context)
        self._refuse = refuse
        self._on_failure = on_failure
        self.add_node(node)

    def _make_handler(self, entity: Any, node: Node, take_from_wait_list: Take) -> Task[Any]:
        take = take_from_wait_list
        if isinstance(entity, Subscription | Service | Client):
            take = partial(self._careful, take_from_wait_list)
        return super()._make_handler(entity, node, take)

    def _careful(self, take: Take, entity: Any) -> Execution | None:
        try:
            execute = take(entity)
        except Exception as error:  # noqa: BLE001 - rclpy has types of its own
            self._note(entity, error)
            return None
        if execute is None:
            return None

        async def careful() -> None:
            try:
                await execute()
            except _ENDS:
                raise
            except Exception as error:  # noqa: BLE001 - whatever a message may lead to
                text = self._note(entity, error)
                # rclpy's own callbacks (/clock, parameters) leave nothing half done.
                if not str(getattr(entity.callback, "__module__", "")).startswith("rclpy."):
                    self._on_failure(text)

        return careful

    def _note(self, entity: Any, error: Exception) -> str:
        if not self.context.ok():
            # After a signal nothing can be published: no message's fault.
            raise error
        kind = type(error).__name__
        source = str(entity.topic if isinstance(entity, Subscription) else entity.srv_name)
        self._refuse(source, kind, f"{kind}: {error}")
        return f"{source}: {kind}: {error}"
