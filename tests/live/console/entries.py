"""The tokens of the consoles that a test has started, as a person reads them from the printed address."""

from __future__ import annotations

from urllib.parse import urlsplit

ENTRIES: dict[int, str] = {}
"""By the port of the page."""


def note(url: str) -> str:
    """Remember the token of a printed address; the address without it."""
    found = urlsplit(url)
    if found.port is not None and found.query:
        ENTRIES[found.port] = found.query
    return url.partition("?")[0]


def entered(url: str) -> str:
    """An address of a page as a person opens it who has read the printed one."""
    found = urlsplit(url)
    query = ENTRIES.get(found.port or 0, "")
    return f"{url}?{query}" if query and not found.query else url
