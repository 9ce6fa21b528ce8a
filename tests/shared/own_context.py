"""A ROS context whose nodes meet nobody else's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
from rclpy.context import Context

from needle_core.process.ros_domain import own_domain


@contextmanager
def own_context() -> Iterator[Context]:
    """Give a context in a domain of its own (`own_domain`), shut down in the end."""
    with own_domain() as domain:
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        try:
            yield context
        finally:
            context.try_shutdown()
