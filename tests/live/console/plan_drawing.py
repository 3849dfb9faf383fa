"""Drawing on the plan page's map with a real mouse."""

from __future__ import annotations

import json

import msgspec

from tests.autonomy.mission_texts import SITE
from tests.live.console.browser import Browser


def window(browser: Browser, east_m: float, north_m: float) -> tuple[float, float]:
    """Where a place of the site is in the window."""
    point = json.dumps(msgspec.to_builtins(SITE.point(east_m, north_m)) | {"altitude_m": None})
    x, y = browser.value(
        "(() => { const b = document.getElementById('plan-map').getBoundingClientRect();"
        f" const p = plan.map.screen({point}); return [b.x + p.x, b.y + p.y]; }})()"
    )
    return x, y


def draw(browser: Browser, tool: str, *places: tuple[float, float], last: int = 1) -> None:
    """Choose a tool and click places; ``last``: clicks on the last one."""
    browser.value(f"document.querySelector('[data-tool={tool}]').click()")
    for i, place in enumerate(places):
        at = window(browser, *place)
        for count in range(1, 1 + (last if i == len(places) - 1 else 1)):
            browser.press(*at, count)
