"""Lets coroutines wait for what happens in other threads."""

import asyncio
import threading


class Bell:
    """Wakes the coroutines of one event loop that wait for it; rung from any thread, it never waits itself."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        """Belong to an event loop, in whose thread this is called."""
        self._loop = loop
        self._thread_id = threading.get_ident()
        self._waiting: set[asyncio.Future[None]] = set()
        self._ringing = False

    def ring(self) -> None:
        """Wake all who wait now; nothing happens once the loop has ended."""
        if self._ringing:
            return
        self._ringing = True
        # in its own thread the loop is awake, and need not be woken through a pipe
        call = (
            self._loop.call_soon
            if threading.get_ident() == self._thread_id
            else self._loop.call_soon_threadsafe
        )
        try:
            call(self._wake)
        except RuntimeError:
            if not self._loop.is_closed():
                raise

    async def wait(self, timeout_s: float | None) -> None:
        """Wait until it rings, or for so long; who looked before in the same step of the loop misses no ring."""
        woken = self._loop.create_future()
        self._waiting.add(woken)
        try:
            if timeout_s is None:
                await woken
            else:
                await asyncio.wait((woken,), timeout=timeout_s)
        finally:
            self._waiting.discard(woken)

    def _wake(self) -> None:
        self._ringing = False
        for woken in self._waiting:
            if not woken.done():
                woken.set_result(None)
