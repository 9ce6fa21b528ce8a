"""A ROS context whose nodes meet nobody else's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
from rclpy.context import Context

from needle_core.process.ros_domain import reserve_domain_id


@contextmanager
def own_context() -> Iterator[Context]:
    """Give a context in a domain of its own (`reserve_domain_id`), shut down in the end."""
    with reserve_domain_id() as domain:
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        try:
            yield context
        finally:
            context.try_shutdown()
