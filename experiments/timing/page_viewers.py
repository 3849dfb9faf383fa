"""``python -m experiments.timing.page_viewers URL --pages N``: N open pages of a console, without their drawing.

Each keeps the websocket of a page, reads every state, and shows a panel: the CAN table, for which the console listens
on the bus, or another one.  Ends on SIGTERM with one line of JSON: ``states``, the number of states received.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import signal
import sys
from contextlib import AsyncExitStack
from typing import Final

from websockets.asyncio.client import ClientConnection, connect

PANELS: Final = ("can", "ticks", "error", "timeline")


class Viewers:
    """Open pages; ``states`` counts what they have got."""

    def __init__(self) -> None:
        self.states = 0

    async def show(self, url: str, pages: int, ended: asyncio.Event) -> None:
        """Keep the pages open until the event; raises OSError when one cannot be opened."""
        async with AsyncExitStack() as stack, asyncio.TaskGroup() as group:
            opened = [await stack.enter_async_context(connect(url, max_size=None)) for _ in range(pages)]
            for number, page in enumerate(opened):
                await page.send(f"panel {PANELS[number % len(PANELS)]}")
            sys.stdout.write('{"ready": true}\n')
            sys.stdout.flush()
            reading = [group.create_task(self._read(page)) for page in opened]
            await ended.wait()
            for task in reading:
                task.cancel()

    async def _read(self, page: ClientConnection) -> None:
        async for _ in page:
            self.states += 1


async def _main(url: str, pages: int) -> int:
    viewers, ended = Viewers(), asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    await viewers.show(url, pages, ended)
    sys.stdout.write(json.dumps({"states": viewers.states}) + "\n")
    return 0


def main() -> int:
    """Run the process; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m experiments.timing.page_viewers", description="Open pages.")
    parser.add_argument("url", help="websocket of the console, as in ws://127.0.0.1:8471/ws")
    parser.add_argument("--pages", type=int, default=10, help="number of pages")
    told = parser.parse_args()
    try:
        return asyncio.run(_main(told.url, told.pages))
    except OSError as error:
        sys.stderr.write(f"viewers: {told.url} cannot be opened ({error}); start the console first\n")
        return 4


if __name__ == "__main__":
    sys.exit(main())
