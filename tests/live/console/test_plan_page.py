"""The plan page in a browser: a mission is drawn by mouse, checked, saved, read back, uploaded and started."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import pytest
from PIL import Image

from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import Fence, Landing
from autonomy.process.planner_process import PlannerProcess
from can_dbc.messages.crane import OperatorAction
from can_dbc.messages.datagrams import decode
from console.console import Console
from console.server import create_app
from machine.status.modes import Mode
from tests.autonomy.mission_checks import EXAMPLES
from tests.autonomy.mission_texts import SITE, at
from tests.live.autonomy.waiting_planner import HASH, PROFILE, planner_process, report_machine
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.control import take_control
from tests.live.console.plan_drawing import draw, window
from tests.live.console.served_page import served
from tests.operator_end import OperatorEnd, udp_end

pytestmark = pytest.mark.skipif(installed() is None, reason=MISSING)
SIZES = [(1280, 800), (800, 1280), (390, 844)]
PICTURE = Path(__file__).parents[3] / "docs" / "how-to" / "plan-on-the-page.png"


@dataclass
class Stage:
    """A console and a planner that waits, in threads; the controller's reports are ours."""

    folder: Path
    operator: socket.socket
    mode: Mode = Mode.STANDBY
    over: bool = False
    port: int = 0

    def begin(self) -> None:
        reports = udp_end()
        self._to = reports.getsockname()
        self.planner: PlannerProcess = planner_process(self._to[1], None, "--missions", str(self.folder))
        console = Console(
            PROFILE,
            HASH,
            Path(self.operator.getsockname()),
            reports=reports,
            missions=self.folder,
            planner=self.planner._commands.getsockname(),
        )
        self._serving = ExitStack()
        self.port = urlsplit(self._serving.enter_context(served(create_app(console)))).port or 0
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def end(self) -> None:
        self.over = True
        self._thread.join()
        self._serving.close()
        self.planner.close()

    def _work(self) -> None:
        while not self.over:
            for to in (self._to, self.planner._link.getsockname()):
                report_machine(to, None, self.mode)
            self.planner.step(time.monotonic_ns())
            time.sleep(0.05)

    def stopped(self, within_s: float = 1.0) -> bool:
        """Whether STOP arrives among the heartbeats of the page."""
        limit = time.monotonic() + within_s
        while time.monotonic() < limit:
            with contextlib.suppress(TimeoutError):
                if decode(self.operator.recv(100)).action is OperatorAction.STOP:
                    return True
        return False


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    with OperatorEnd(tmp_path / "operator") as operator:
        operator.settimeout(0.5)
        made = Stage(tmp_path / "missions", operator)
        made.begin()
        yield made
        made.end()


@pytest.fixture
def browser(stage: Stage, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Browser]:
    with Browser(tmp_path, *getattr(request, "param", ((1280, 800),))) as made:
        begin(made, stage)
        yield made


def begin(browser: Browser, stage: Stage) -> None:
    browser.open(f"http://127.0.0.1:{stage.port}/plan")
    browser.until("document.body?.dataset.ready === 'yes'")


def metres(browser: Browser, list_name: str) -> list[tuple[int, int]]:
    """The places of a list, in whole metres."""
    items = browser.value(f"plan.model.mission.{list_name}.map(x => x.position ?? x)")
    found = [SITE.local(p["latitude_deg"], p["longitude_deg"]) for p in items]
    return [(round(e), round(n)) for e, n, _ in found]


def test_a_mission_is_planned_by_mouse_and_driven(stage: Stage, browser: Browser) -> None:
    browser.shows("findings", "has no waypoints")
    draw(browser, "waypoint", (-20, 0), (10, 0), (10, 30))
    draw(browser, "fence", (-35, -20), (35, -20), (35, 12), (-35, 12), last=2)
    draw(browser, "log", (-5, 4))
    draw(browser, "landing", (-15, -8))
    assert metres(browser, "waypoints") == [(-20, 0), (10, 0), (10, 30)]
    assert metres(browser, "fences[0].corners") == [(-35, -20), (35, -20), (35, 12), (-35, 12)]
    assert (metres(browser, "logs"), metres(browser, "landings")) == ([(-5, 4)], [(-15, -8)])
    browser.shows("findings", "waypoint 3 is 18.0 m outside of the fence")
    assert browser.value("document.querySelectorAll('.mark.error').length") == 1, "on the map, too"

    browser.value("document.querySelector('[data-tool=move]').click()")
    browser.drag(window(browser, 10, 30), window(browser, 30, 5))
    browser.until("plan.model.mission.waypoints.length === 3")
    browser.wait(lambda: metres(browser, "waypoints")[2] == (30, 5), "the dragged waypoint")
    assert metres(browser, "waypoints")[:2] == [(-20, 0), (10, 0)]
    browser.shows("check-state", "can be driven")
    assert (browser.text("duration").endswith("min") and browser.text("route") == "51 m") or browser.text("length")

    before = browser.value("JSON.stringify(plan.model.mission)")
    browser.click("save")
    browser.shows("file-note", "Saved as mission.geojson.")
    browser.click("clear")
    browser.until("plan.model.mission.waypoints.length === 0")
    browser.click("open-saved")
    browser.until("plan.model.mission.waypoints.length === 3")
    told, kept = (json.loads(text) for text in (browser.value("JSON.stringify(plan.model.mission)"), before))
    assert {k: told[k] for k in ("waypoints", "fences", "landings", "logs")} == {
        k: kept[k] for k in ("waypoints", "fences", "landings", "logs")
    }
    assert (
        load_mission(stage.folder / "mission.geojson").mission.logs[0].position.latitude_deg
        == (kept["logs"][0]["position"]["latitude_deg"])
    )

    stage.mode = Mode.ARMED
    browser.shows("mode", "ARMED")
    take_control(browser)
    browser.until("!document.getElementById('upload').disabled")
    browser.click("upload")
    browser.shows("run-note", "the machine is armed; disarm it first")
    stage.mode = Mode.STANDBY
    browser.shows("mode", "STANDBY")
    browser.click("upload")
    browser.shows("run-note", "The planner has the mission")
    browser.until("!document.getElementById('auto').disabled")
    browser.click("auto")
    browser.until("!document.getElementById('pause').disabled")
    browser.click("pause")
    browser.until("document.getElementById('pause').disabled")


def test_a_right_click_removes_a_point(browser: Browser) -> None:
    mission = msgspec.to_builtins(load_mission(EXAMPLES / "paper_b.geojson").mission)
    browser.value(f"plan.model.commit({json.dumps(mission)}); document.getElementById('fit').click()")
    for east_m, north_m in ((20, 15), (-30, 25)):
        x, y = window(browser, east_m, north_m)
        browser._ask("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        for kind in ("mousePressed", "mouseReleased"):
            browser._ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="right", clickCount=1)
        browser.until("plan.model.mission.waypoints.length === 3")
    browser.until("plan.model.mission.fences[0].corners.length === 3")


def test_exchanged_axes_are_named_and_put_right(browser: Browser) -> None:
    mission = msgspec.to_builtins(load_mission(EXAMPLES / "paper_b.geojson").mission)
    mission["fences"] = mission["logs"] = []
    mission["waypoints"] = [
        p | {"latitude_deg": p["longitude_deg"], "longitude_deg": p["latitude_deg"]} for p in mission["waypoints"]
    ]
    browser.value(f"plan.model.commit({json.dumps(mission)})")
    browser.shows("findings", "latitude and longitude look swapped")
    browser.click("exchange")
    browser.shows("check-state", "can be driven")
    assert metres(browser, "waypoints") == [(-20, -15), (20, -15), (20, 15), (-20, 15)]


def test_a_typed_place_is_taken_undone_and_deleted(stage: Stage, browser: Browser) -> None:
    browser.click("add")
    browser.value(
        "(e => { e.focus(); e.select(); })(document.querySelector('[aria-label=\"waypoint 1: east, metres\"]'))"
    )
    browser.keys("12.5")
    browser.keys("Tab")
    browser.value("document.activeElement.blur()")
    browser.wait(lambda: metres(browser, "waypoints") == [(12, 0)], "the typed place")
    far = browser.value("plan.model.mission.waypoints[0]")
    east, north, _ = SITE.local(far["latitude_deg"], far["longitude_deg"])
    assert (east, north) == (pytest.approx(12.5, abs=1e-4), pytest.approx(0.0, abs=1e-4)), "as pymap3d computes it"
    browser.click("undo")
    browser.wait(lambda: metres(browser, "waypoints") == [(0, 0)], "undone")
    browser.click("redo")
    browser.value("plan.model.choose(['waypoint', 0])")
    browser.click("delete")
    browser.until("plan.model.mission.waypoints.length === 0")
    assert not stage.stopped()


def test_a_row_far_down_a_long_list_keeps_the_keyboard(browser: Browser) -> None:
    mission = msgspec.to_builtins(load_mission(EXAMPLES / "paper_b.geojson").mission)
    mission["logs"] = list(mission["logs"][:1]) * 500
    browser.value(f"plan.model.commit({json.dumps(mission)}); plan.model.choose(['log', 250])")
    row = "log 300: east, metres"
    browser.value(f"document.querySelector('[aria-label=\"{row}\"]').focus()")
    assert browser.value("document.activeElement.ariaLabel") == row
    assert browser.value("plan.model.chosen") == ["log", 299]


def test_a_plan_is_made_with_the_keyboard_alone(browser: Browser) -> None:
    def enter(selector: str) -> None:
        browser.value(f"document.querySelector({selector!r}).focus()")
        for kind, text in (("keyDown", "\r"), ("keyUp", "")):
            browser._ask(
                "Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", text=text, windowsVirtualKeyCode=13
            )

    for _ in range(3):
        enter("#add")
    enter("[data-tab=fence]")
    enter("#add")
    enter("#add-corner")
    browser.shows("check-state", "can be driven")
    assert metres(browser, "waypoints") == [(0, 0), (5, 0), (10, 0)]
    assert metres(browser, "fences[0].corners") == [(-10, -10), (5, -10), (20, -10), (20, 10), (-10, 10)]


def test_stop_is_there_by_click_and_key_but_not_while_typing(stage: Stage, browser: Browser) -> None:
    browser.until("!document.getElementById('stop').disabled")
    browser.value("document.getElementById('option-name').focus()")
    for kind in ("rawKeyDown", "keyUp"):
        browser._ask("Input.dispatchKeyEvent", type=kind, key=" ", code="Space")
    assert not stage.stopped()
    browser.keys("Escape")
    assert stage.stopped(10.0)
    browser.click("stop")
    assert stage.stopped(10.0)


def test_a_page_with_another_source_or_style_is_not_needed(browser: Browser) -> None:
    """The strict policy holds while everything is used: nothing was refused by it."""
    browser.value(
        "document.addEventListener('securitypolicyviolation', e => { window.refused = e.violatedDirective; })"
    )
    draw(browser, "keep-out", (-10, -10), (10, -10), (0, 10), last=2)
    draw(browser, "log", (15, 15))
    browser.value("document.querySelector('[data-tool=move]').click()")
    browser.until("plan.model.mission.fences.length === 1 && plan.model.mission.fences[0].keep_out")
    assert browser.value("window.refused") is None


def test_files_are_read_and_written_by_the_page(stage: Stage, browser: Browser, tmp_path: Path) -> None:
    browser.choose_file("import", EXAMPLES / "paper_b.geojson")
    browser.shows("file-note", "paper_b.geojson: GeoJSON.")
    browser.choose_file("import", EXAMPLES / "harvest.hpr")
    browser.shows("file-note", "logs added")
    assert browser.value("plan.model.mission.waypoints.length") == 4
    assert browser.value("plan.model.mission.logs.length") > 12
    (tmp_path / "bad.gpx").write_text("<gpx><rte><rtept/></rte></gpx>")
    browser.choose_file("import", tmp_path / "bad.gpx")
    browser.shows("file-note", "bad.gpx:1: this rtept has no lat")
    browser._ask("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path / "down"))
    browser.value("document.getElementById('format').value = 'kml'")
    browser.click("export")
    browser.shows("file-note", "mission.kml does not hold: option laps.")
    browser.wait(lambda: (tmp_path / "down" / "mission.kml").exists(), "the download")
    assert len(load_mission(tmp_path / "down" / "mission.kml").mission.waypoints) == 4


def test_a_name_in_use_is_replaced_on_purpose_and_any_other_refusal_is_told(stage: Stage, browser: Browser) -> None:
    stage.folder.mkdir()
    file = stage.folder / "mission.geojson"
    file.write_text("saved from another browser, after this page was opened")
    browser.click("save")
    browser.shows("file-note", "mission.geojson exists already. Press Replace")
    browser.click("save")
    browser.shows("file-note", "Saved as mission.geojson.")
    browser.until("document.getElementById('saved').value === 'mission.geojson'")
    file.unlink()
    stage.folder.rmdir()
    stage.folder.write_text("no folder")
    browser.click("save")
    browser.shows("file-note", "missions is no folder")
    assert browser.text("save") == "Save"


def test_imported_logs_are_added_to_whatever_is_planned(browser: Browser) -> None:
    browser.choose_file("import", EXAMPLES / "harvest.hpr")
    browser.shows("file-note", "harvest.hpr: ")
    logs = browser.value("plan.model.mission.logs.length")
    draw(browser, "landing", (-15, -8))
    browser.choose_file("import", EXAMPLES / "harvest.hpr")
    browser.until(f"plan.model.mission.logs.length === {2 * logs}")
    assert browser.value("plan.model.mission.landings.length") == 1


def test_a_picture_lies_under_the_grid_where_it_is_placed(browser: Browser, tmp_path: Path) -> None:
    Image.new("RGB", (40, 40), (200, 40, 90)).save(tmp_path / "site.png")
    browser.choose_file("picture", tmp_path / "site.png")
    browser.until("document.getElementById('picture-width_m')?.value === '100'")
    (x, y), (left, top) = (
        window(browser, 33, 33),
        browser.value("(b => [b.x, b.y])(document.getElementById('plan-map').getBoundingClientRect())"),
    )
    pixel = f"[...document.querySelector('.grid').getContext('2d').getImageData({x - left}, {y - top}, 1, 1).data]"
    red, green, blue, _ = browser.value(pixel)
    assert red > 2 * green and red > blue
    browser.value(
        "(e => { e.value = '60'; e.dispatchEvent(new Event('change')); })(document.getElementById('picture-width_m'))"
    )
    browser.wait(lambda: browser.value(pixel)[3] == 0, "60 m from -50 m do not reach there")


def test_the_machine_s_page_links_here_and_shows_a_planner_that_waits(stage: Stage, browser: Browser) -> None:
    browser.open(f"http://127.0.0.1:{stage.port}/")
    browser.shows("mission-words", "The machine waits for a mission.")
    browser.click("plan-link")
    browser.until("document.body?.dataset.ready === 'yes'")
    browser.shows("planner-words", "The machine waits for a mission.")


@pytest.mark.parametrize("browser", [(size, light) for size in SIZES for light in (False, True)], indirect=True)
def test_nothing_is_cut_off_at_the_usual_sizes(browser: Browser) -> None:
    paper_b = load_mission(EXAMPLES / "paper_b.geojson").mission
    wet = Fence(tuple(at(*corner) for corner in ((-6, -5), (9, -6), (12, 3), (-4, 6))), True, "wet ground")
    one, two, _, four = paper_b.waypoints
    changed = msgspec.structs.replace(
        paper_b,
        waypoints=(one, two, at(29, 15), four),
        fences=(*paper_b.fences, wet),
        landings=(Landing(at(-25, -21), "road side", 90.0),),
    )
    mission = msgspec.to_builtins(changed)
    browser.value(f"plan.model.commit({json.dumps(mission)}); document.getElementById('fit').click()")
    browser.shows("findings", "waypoint 3 is 1.0 m from the fence")
    browser.value("plan.model.choose(['waypoint', 2])")
    assert browser.value("document.documentElement.scrollWidth <= innerWidth")
    assert browser.value(
        "(b => b.width > 150 && b.height > 55 && b.bottom <= innerHeight && b.top >= 0)"
        "(document.getElementById('stop').getBoundingClientRect())"
    )
    unnamed = browser.value(
        "[...document.querySelectorAll('button, input, select')].filter(e => e.checkVisibility() &&"
        " !(e.innerText || e.labels?.length || e.ariaLabel)).map(e => e.outerHTML)"
    )
    assert unnamed == []
    if os.environ.get("TIMBERHAND_PICTURES"):
        size = browser.value("`${innerWidth}x${innerHeight}`")
        light = browser.value("matchMedia('(prefers-color-scheme: light)').matches")
        browser.picture(
            PICTURE
            if size == "1280x800" and not light
            else Path(f"{os.environ['TIMBERHAND_PICTURES']}/plan-{size}{'-light' if light else ''}.png")
        )
