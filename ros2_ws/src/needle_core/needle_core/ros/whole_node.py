"""Nodes that are there whole, or not at all."""

from __future__ import annotations

import contextlib
from typing import Any

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
