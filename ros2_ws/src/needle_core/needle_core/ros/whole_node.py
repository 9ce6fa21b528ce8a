"""Nodes that are there whole, or not at all."""

from __future__ import annotations

import contextlib
from typing import Any

from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node


class _WholeOrGone(type):
    """Destroys a node whose construction fails: others would see it for as long as an error lasts.

    The error's traceback holds the half-made node, and with it all that it had published and heard.
    """

    def __call__(cls: Any, *args: Any, **kwargs: Any) -> Any:
        node = cls.__new__(cls, *args, **kwargs)
        try:
            node.__init__(*args, **kwargs)
        except BaseException:
            # Before rclpy has made its own part there is nothing to destroy.
            with contextlib.suppress(AttributeError):
                node.destroy_node()
            raise
        return node


class WholeNode(Node, metaclass=_WholeOrGone):
    """A node that is destroyed if its construction fails."""


class WholeLifecycleNode(LifecycleNode, metaclass=_WholeOrGone):
    """A lifecycle node that is destroyed if its construction fails."""

    def destroy_node(self) -> None:
        """Destroy the node, and what rclpy leaves of it: its states, which keep it alive."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()
