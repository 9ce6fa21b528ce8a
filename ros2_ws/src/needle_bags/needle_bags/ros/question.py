"""A question to another node's service that is asked again until it is answered.

An answer can be lost for good: a server whose process does not know the client yet drops it, and
neither side is told. Only for what may be asked twice.
"""

from __future__ import annotations

import collections
import time
from collections.abc import Callable
from typing import Any

from rclpy.client import Client
from rclpy.task import Future

ASK_AGAIN = 1.0
# More requests than a service keeps by default would not be answered anyhow.
MOST_PENDING = 10


class Question:
    """One request, sent once a period until one of its answers has come, however late.

    Parameters
    ----------
    client : Client
        Of the service that is asked; only this question may use it.
    take : callable
        Called with the first answer, once.

    Attributes
    ----------
    answered : bool
        Whether it has come.
    """

    def __init__(self, client: Client[Any, Any], take: Callable[[Any], None]) -> None:
        self._client = client
        self._take = take
        self._pending: collections.deque[Future[Any]] = collections.deque()
        self._next = time.monotonic()
        self.answered = False

    def ask(self, request: Any) -> None:
        """Send the request if it is time to, the service is there and no answer has come yet."""
        now = time.monotonic()
        if self.answered or now < self._next or not self._client.service_is_ready():
            return
        self._next = now + ASK_AGAIN
        while len(self._pending) >= MOST_PENDING:
            self._client.remove_pending_request(self._pending.popleft())
        future = self._client.call_async(request)
        self._pending.append(future)
        future.add_done_callback(self._on_answer)

    def _on_answer(self, future: Future[Any]) -> None:
        response = future.result()
        if self.answered or response is None:
            return
        self.answered = True
        for pending in self._pending:
            self._client.remove_pending_request(pending)
        self._pending.clear()
        self._take(response)
