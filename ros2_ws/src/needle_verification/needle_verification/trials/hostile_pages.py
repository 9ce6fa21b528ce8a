"""Pages that should not be there, all at once, over and over: as a process of its own.

`python -m needle_verification.trials.hostile_pages PAGE_PORT HOLD_PORT TOKEN` goes on until it is
ended. Only some of them know the token: a page of ours that has gone mad.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import socket
import sys
from collections.abc import Awaitable, Callable
from typing import Any

_PAGES_AT_ONCE = 50
_FLOOD = 10_000
_HUGE = 1_000_000
_PAUSE = 0.1
_PRESS = {"nonce": "", "sequence": 1, "pressed": True, "speed": 1.0, "mode": "insert"}


class HostilePages:
    """Attempts of hostile pages.

    Parameters
    ----------
    page_port, hold_port : int
        Where page and hold are served.
    token : str
        The right one.
    """

    def __init__(self, page_port: int, hold_port: int, token: str) -> None:
        self._origin = f"http://127.0.0.1:{page_port}"
        self._port = hold_port
        self._token = token

    async def go_on(self) -> None:
        """Try all of it, over and over."""
        tries: tuple[Callable[[], Awaitable[None]], ...] = (
            self._foreign_host,
            self._foreign_origin,
            self._no_origin,
            self._wrong_token,
            self._garbage,
            self._not_a_number,
            self._too_much,
        )
        await asyncio.gather(*(self._repeat(one) for one in tries))

    async def _too_much(self) -> None:
        # One after the other: they would take each other's places.
        for one in (self._huge, self._flood, self._flood_without_token, self._many):
            with contextlib.suppress(Exception):
                await one()

    async def _repeat(self, one: Callable[[], Awaitable[None]]) -> None:
        while True:
            # To be refused is what they are there for.
            with contextlib.suppress(Exception):
                await one()
            await asyncio.sleep(_PAUSE)

    def _connect(self, host: str = "127.0.0.1", origin: str | None = "") -> Any:
        # Only what tries the console needs it.
        from websockets.asyncio.client import connect  # noqa: PLC0415

        plain = socket.create_connection(("127.0.0.1", self._port))
        address = f"ws://{host}:{self._port}/hold"
        return connect(address, sock=plain, origin=self._origin if origin == "" else origin)

    async def _press(self, page: Any, token: str) -> None:
        """Press as a page does that believes that it is let in."""
        await page.send(json.dumps({"token": token}))
        for sequence in itertools.count(1):
            told = json.loads(await page.recv())
            await page.send(json.dumps({**_PRESS, **told, "sequence": sequence}))

    async def _foreign_host(self) -> None:
        async with self._connect(host="evil.example") as page:
            await self._press(page, self._token)

    async def _foreign_origin(self) -> None:
        async with self._connect(origin="http://evil.example") as page:
            await self._press(page, self._token)

    async def _no_origin(self) -> None:
        async with self._connect(origin=None) as page:
            await self._press(page, self._token)

    async def _wrong_token(self) -> None:
        async with self._connect() as page:
            await self._press(page, self._token[:-1])

    async def _garbage(self) -> None:
        async with self._connect() as page:
            await page.send(json.dumps({"token": self._token}))
            for data in ("{", "[]", b"\0\xff", '{"pressed": true}', "\ud7ff", "[" * 200):
                await page.send(data)

    async def _not_a_number(self) -> None:
        async with self._connect() as page:
            await page.send(json.dumps({"token": self._token}))
            for sequence in range(1, 20):
                nonce = json.loads(await page.recv())["nonce"]
                message = {**_PRESS, "nonce": nonce, "sequence": sequence, "speed": float("nan")}
                await page.send(json.dumps(message))

    async def _huge(self) -> None:
        async with self._connect() as page:
            await page.send(json.dumps({"token": self._token}))
            await page.send("x" * _HUGE)
            await page.wait_closed()

    async def _flood(self) -> None:
        async with self._connect() as page:
            await page.send(json.dumps({"token": self._token}))
            for sequence in range(_FLOOD):
                await page.send(json.dumps({**_PRESS, "sequence": sequence}))

    async def _flood_without_token(self) -> None:
        async with self._connect() as page:
            for sequence in range(_FLOOD):
                await page.send(json.dumps({**_PRESS, "sequence": sequence}))

    async def _many(self) -> None:
        async with contextlib.AsyncExitStack() as stack:
            for _ in range(_PAGES_AT_ONCE):
                with contextlib.suppress(Exception):
                    page = await stack.enter_async_context(self._connect())
                    await page.send(json.dumps({"token": self._token}))


def main() -> int:
    """Go on until the process is ended; returns the exit code."""
    page_port, hold_port, token = sys.argv[1:]
    asyncio.run(HostilePages(int(page_port), int(hold_port), token).go_on())
    return 0


if __name__ == "__main__":
    sys.exit(main())
