"""A service request that is repeated until it is answered.

An answer can be lost for good: a server that has not discovered the client yet drops it without
notice. Use this for idempotent requests only.
"""

from __future__ import annotations

import collections
import time
from collections.abc import Callable
from typing import Any

from rclpy.client import Client
from rclpy.task import Future

RETRY_PERIOD = 1.0
# A service queues no more requests than this by default.
MAX_PENDING = 10


class RepeatedRequest:
    """A request that is sent once a period until the first answer arrives.

    Parameters
    ----------
    client : Client
        Client of the service; used by this request only.
    on_answer : callable
        Called once, with the first answer.

    Attributes
    ----------
    answered : bool
        Whether the answer has arrived.
    """

    def __init__(self, client: Client[Any, Any], on_answer: Callable[[Any], None]) -> None:
        self._client = client
        self._on_answer = on_answer
        self._pending: collections.deque[Future[Any]] = collections.deque()
        self._next = time.monotonic()
        self.answered = False

    def send(self, request: Any) -> None:
        """Send the request if it is due, unanswered, and the service is available."""
        now = time.monotonic()
        if self.answered or now < self._next or not self._client.service_is_ready():
            return
        self._next = now + RETRY_PERIOD
        while len(self._pending) >= MAX_PENDING:
            self._client.remove_pending_request(self._pending.popleft())
        future = self._client.call_async(request)
        self._pending.append(future)
        future.add_done_callback(self._receive)

    def _receive(self, future: Future[Any]) -> None:
        response = future.result()
        if self.answered or response is None:
            return
        self.answered = True
        for pending in self._pending:
            self._client.remove_pending_request(pending)
        self._pending.clear()
        self._on_answer(response)
