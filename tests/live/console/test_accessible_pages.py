"""axe finds nothing on any page, with any panel open, dark and light: names, roles, contrast, keyboard.

Deque's axe-core is loaded into the page by the browser's debugger, so that the page's own policy stays as it is.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import encode_mission
from console.accounts import Accounts, Role
from console.console import CommissionOptions, Console
from console.plant_link import create_plant_app
from console.replay_server import create_replay_app
from console.server import create_app
from machine.loading.profile_file import load_profile, profile_file, profile_hash
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack
from tests.can_dbc.example_mission_report import MISSION_REPORT
from tests.console.recorded_run import PROFILE as RECORDED
from tests.console.recorded_run import RecordedRun
from tests.console.state_reports import REPORT
from tests.console.vehicle_reports import VEHICLE
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.served_page import fed, served
from tests.operator_end import udp_end

pytestmark = [pytest.mark.skipif(installed() is None, reason=MISSING), pytest.mark.timeout(300)]
AXE = (Path(__file__).with_name("axe") / "axe.min.js").read_text()
PROFILE = load_profile("aoro_fc8")
HASH = profile_hash(PROFILE)
COUNT = itertools.count(1)
RUN = """axe.run(document, {resultTypes: ['violations']}).then(found => found.violations.map(v => {
  const where = n => `${n.target.join(' ')} [${[...n.any, ...n.all, ...n.none].map(a => a.message).join('; ')}]`;
  return `${v.id}: ${v.nodes.map(where).join(' | ')}`; }))"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Every page that is served: a live machine with a stop, its sign-in, a recording, a silent plant."""
    folder = tmp_path_factory.mktemp("pages")
    with ExitStack() as stack:
        reports, silent = (stack.enter_context(udp_end()) for _ in range(2))
        nobody = silent.getsockname()
        console = Console(
            PROFILE,
            HASH,
            folder / "operator",
            reports=reports,
            planner=nobody,
            scene=nobody,
            missions=folder / "missions",
            timing_page=folder / "timing",
            buses={PROFILE.crane_bus: "virtual:axe"},
            faults=folder / "desk",
            truth=nobody,
            commission=CommissionOptions(nobody, profile_file("aoro_fc8"), folder / "commissioning"),
        )
        guarded = Console(PROFILE, HASH, accounts=Accounts({"anna": (Role.VIEWER, "")}))
        (folder / "missions").mkdir()
        stack.enter_context(fed(reports.getsockname(), 0.05, _told))
        live = stack.enter_context(served(create_app(console)))
        replay = stack.enter_context(served(create_replay_app(RecordedRun(), RECORDED, name="runs/demo-1")))
        yield {
            "machine": live,
            "plan": f"{live}plan",
            "commission": f"{live}commission",
            "sign-in": f"{stack.enter_context(served(create_app(guarded)))}sign-in",
            "recording": replay,
            "plant": stack.enter_context(served(create_plant_app(nobody))),
        }


def _told(now_ns: int) -> Iterator[bytes]:
    """Ten seconds of work and ten of a stop, in turn, and a mission every 0.25 s."""
    n = next(COUNT)
    stopped = replace(REPORT, mode=Mode.STOP, reason=pack(Reason.JOINT_STUCK, 1))
    yield encode(replace(stopped if n % 400 > 200 else REPORT, profile_hash=HASH, stamp_ns=now_ns))
    yield encode(replace(VEHICLE, stamp_ns=now_ns))
    if n % 5 == 0:
        yield encode_mission(MISSION_REPORT, n, HASH, now_ns)


@pytest.fixture(params=[False, True], ids=["dark", "light"])
def browser(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Browser]:
    with Browser(tmp_path, (1280, 800), request.param) as opened:
        yield opened


def _panels(browser: Browser) -> list[str]:
    return list(
        browser.value("[...document.querySelectorAll('[role=tab]')].filter(t => t.checkVisibility()).map(t => t.id)")
    )


def _ready(name: str, browser: Browser) -> Callable[[], Any]:
    return {
        "machine": lambda: browser.text("mission-words") and browser.text("shift"),
        "plan": lambda: browser.value("document.body?.dataset.ready === 'yes'"),
        "commission": lambda: browser.value("document.body?.dataset.ready === 'yes'"),
        "sign-in": lambda: browser.text("enter"),
        "recording": lambda: "runs/demo-1" in browser.text("replay"),
        "plant": lambda: browser.value("document.body.innerText.includes('does not respond')"),
    }[name]


@pytest.mark.parametrize("name", ["machine", "plan", "commission", "sign-in", "recording", "plant"])
def test_axe_finds_nothing(pages: dict[str, str], browser: Browser, name: str) -> None:
    browser.open(pages[name])
    browser.wait(_ready(name, browser), f"the page {name} is ready")
    browser.value(AXE + "; 0")
    found = {"": browser.value(RUN)}
    for tab in _panels(browser) if name in ("machine", "recording") else ():
        browser.click(tab)
        time.sleep(0.6)  # the server sends a panel's data twice a second
        found[tab] = browser.value(RUN)
    assert not any(found.values()), "\n".join(f"{where}: {one}" for where, all in found.items() for one in all)


def test_axe_would_find_a_button_without_a_name(pages: dict[str, str], tmp_path: Path) -> None:
    with Browser(tmp_path, (1280, 800)) as browser:
        browser.open(pages["plant"])
        browser.value(AXE + "; document.body.append(document.createElement('button')); 0")
        assert any(each.startswith("button-name") for each in browser.value(RUN))
