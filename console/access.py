"""Who is at which page: sign-in, the pages' tokens, roles, and what each may command.

A session is opened by a person: with the accounts by name and password, on this machine alone by the console's token,
which is drawn at the start and stands in the address that the console prints.  A cookie keeps the session.  A page of a
session asks for a token of its own, which every command and the websocket must carry: a page of another site cannot
read it, so it can command nothing even where the browser adds the cookie.  Without a session whoever is on this machine
looks, and presses STOP.  The control lease belongs to one page.

Pure but for the tokens' randomness; `console.access_routes` and `console.access_guards` are the shell.
"""

from __future__ import annotations

import contextlib
import hmac
import secrets
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from console.accounts import Accounts, Person, Role

# -- The control lease: which one page may command the machine now.  Pure.
#
# A page takes it on purpose, and keeps it while it shows signs of life; without one for `LEASE_NS` nobody has it.
# Whoever takes it from another names the page that has it, so that a click on an outdated display takes nothing.


LEASE_NS: Final = 4_000_000_000
"""So long the lease outlives its page: enough to go from one page of the console to another."""


class ControlLease:
    """Pages are known by their numbers; 0 is no page."""

    def __init__(self) -> None:
        self._page = 0
        self._heard_ns = 0

    def holder(self, now_ns: int) -> int:
        """Return the page that has the lease."""
        if self._page and now_ns - self._heard_ns >= LEASE_NS:
            self._page = 0
        return self._page

    def take(self, page: int, over: int, now_ns: int) -> bool:
        """Let ``page`` take the lease, from nobody or from the page ``over``; tell whether it has it now."""
        holder = self.holder(now_ns)
        if holder not in (0, page, over):
            return False
        self._page, self._heard_ns = page, now_ns
        return True

    def renew(self, page: int, now_ns: int) -> None:
        """Note a sign of life of a page; it revives no lease that has ended."""
        if page and self.holder(now_ns) == page:
            self._heard_ns = now_ns

    def give_back(self, page: int, now_ns: int) -> None:
        """End the page's lease, which it does not need any more."""
        if self.holder(now_ns) == page:
            self._page = 0


# -- Who is at which page


SESSION_NS: Final = 12 * 3600 * 1_000_000_000
"""A shift: after it a person signs in again."""
MAX_PAGES: Final = 256
MAX_SESSIONS: Final = 64
MAX_FAILURES: Final = 5
FAILURES_NS: Final = 30_000_000_000
"""After so many wrong passwords within this time nobody may try one; on this machine STOP and the pages that are open
go on."""
LOCAL: Final = Person("this machine", Role.TECHNICIAN)
VISITOR: Final = Person("", Role.VIEWER)
TOKEN_BYTES: Final = 32
ENTRY_BYTES: Final = 16
"""Of the token in the printed address: 128 bits, and the address fits into a line of a terminal."""


@dataclass(slots=True)
class Session:
    """A person who has signed in."""

    person: Person
    until_ns: int


@dataclass(frozen=True, slots=True)
class Page:
    """A page in one tab of a browser."""

    number: int
    token: str
    person: Person
    session: str


class Access:
    """``accounts`` None: only this machine is served, and ``token`` opens a session; empty where persons sign in."""

    def __init__(self, accounts: Accounts | None, clock: Callable[[], int]) -> None:
        self.accounts = accounts
        self.token = "" if accounts is not None else secrets.token_urlsafe(ENTRY_BYTES)
        self.lease = ControlLease()
        self._clock = clock
        self._pages: dict[str, Page] = {}
        self._sessions: dict[str, Session] = {}
        self._failures: deque[int] = deque(maxlen=MAX_FAILURES)
        self._number = 0
        self._connected: set[int] = set()

    # ---- persons

    def may_try(self) -> bool:
        """Tell whether a password may be tried now."""
        full = len(self._failures) == MAX_FAILURES
        return not (full and self._clock() - self._failures[0] < FAILURES_NS)

    def signed_in(self, person: Person | None) -> str:
        """Begin a session for the person of a checked password; a wrong one (None) counts, and gives none."""
        if person is None:
            self._failures.append(self._clock())
            return ""
        return self._begin(person)

    def enter(self, token: str) -> str:
        """Begin a session for whoever has the console's token; empty for a wrong one, which cannot be guessed."""
        right = self.token and hmac.compare_digest(token.encode(errors="replace"), self.token.encode())
        return self._begin(LOCAL) if right else ""

    def _begin(self, person: Person) -> str:
        self._forget()
        while len(self._sessions) >= MAX_SESSIONS:
            self.sign_out(next(iter(self._sessions)))
        session = secrets.token_urlsafe(TOKEN_BYTES)
        self._sessions[session] = Session(person, self._clock() + SESSION_NS)
        return session

    def sign_out(self, session: str) -> None:
        """End a session, with its pages and their lease."""
        self._sessions.pop(session, None)
        for page in [p for p in self._pages.values() if p.session == session]:
            self.lease.give_back(page.number, self._clock())
            del self._pages[page.token]

    def person(self, session: str) -> Person | None:
        """Return who sends a request; None: nobody who has signed in, where that is needed to look."""
        self._forget()
        active_session = self._sessions.get(session)
        if active_session is None:
            return VISITOR if self.accounts is None else None
        return active_session.person

    # ---- pages

    def page(self, token: str, session: str) -> Page | None:
        """Find the page that a token names, if the request is of the session for which it was made."""
        self._forget()
        page = self._pages.get(token)
        return page if page is not None and page.session == session else None

    def open_page(self, token: str, session: str) -> Page | None:
        """Return the page with this token, or a new one; None: there is no such session.

        A token that a page uses already is that of a duplicated tab, which becomes a page of its own.
        """
        known = self.page(token, session)
        active_session = self._sessions.get(session)
        if active_session is None:
            return None
        if known is not None and known.number not in self._connected:
            return known
        holder = self.lease.holder(self._clock())
        while len(self._pages) >= MAX_PAGES:
            idle = (p for p in self._pages.values() if p.number != holder and p.number not in self._connected)
            oldest = next(idle, None) or next(p for p in self._pages.values() if p.number != holder)
            del self._pages[oldest.token]
        self._number += 1
        page = Page(self._number, secrets.token_urlsafe(TOKEN_BYTES), active_session.person, session)
        self._pages[page.token] = page
        return page

    def is_connected(self, token: str) -> bool:
        """Tell whether the page with this token has a websocket."""
        page = self._pages.get(token)
        return page is not None and page.number in self._connected

    @contextlib.contextmanager
    def connected(self, page: Page | None) -> Iterator[None]:
        """Count the page as one with a websocket while the context lasts."""
        number = 0 if page is None else page.number
        self._connected.add(number)
        try:
            yield
        finally:
            self._connected.discard(number)

    # ---- the lease

    def take(self, page: Page, over: int) -> str:
        """Take the lease from nobody or from page ``over``; why not, empty when it is taken."""
        if page.person.role < Role.OPERATOR:
            return f"{page.person.name or 'This page'} is a viewer; an operator may take control."
        if self.lease.take(page.number, over, self._clock()):
            return ""
        return f"{self._holder_words()} has control; look again, then take it over."

    def refusal(self, page: Page | None, role: Role, leased: bool) -> str:
        """Say why the page may not command something that needs a role, and the lease if ``leased``; empty: it may."""
        if page is None or page.person.role < role:
            return f"This needs the role {role.name.lower()}."
        if leased and self.lease.holder(self._clock()) != page.number:
            holder = self._holder_words()
            return f"{holder} has control; take it over first." if holder else "Nobody has control; take control first."
        return ""

    def is_valid(self, page: Page | None, session: str) -> bool:
        """Tell whether a page may go on; one that only looks, without a token, may while its session may look."""
        return self.person(session) is not None and (page is None or page.token in self._pages)

    def give_back(self, page: Page) -> None:
        """End the page's lease, which it does not need any more."""
        self.lease.give_back(page.number, self._clock())

    def leads(self, page: Page | None) -> bool:
        """Tell whether the page has the lease."""
        return page is not None and self.lease.holder(self._clock()) == page.number

    def state(self, page: Page | None, person: Person) -> dict[str, Any]:
        """Tell the page who it is, and who has control."""
        holder = self.lease.holder(self._clock())
        return {
            "role": person.role.name.lower(),
            "lease": {
                "page": holder,
                "holder": self._holder_words() if holder else "",
                "mine": page is not None and holder == page.number,
                "may_take": page is not None and person.role >= Role.OPERATOR,
            },
        }

    def _holder_words(self) -> str:
        number = self.lease.holder(self._clock())
        page = next((p for p in self._pages.values() if p.number == number), None)
        return "" if page is None else f"{page.person.name} (page {number})"

    def _forget(self) -> None:
        now_ns = self._clock()
        for session in [key for key, active_session in self._sessions.items() if now_ns >= active_session.until_ns]:
            self.sign_out(session)
