// The plan page: puts model, map, table, check, files and run together.

import { createCheck } from "./check.js";
import { createFields, number, whole, words } from "./fields.js";
import { createFiles } from "./files.js";
import { createFrame } from "./frame.js";
import { alarm, createHeader } from "./header.js";
import { createMap } from "./map.js";
import { allPlaces, createModel, exchanged, without } from "./model.js";
import { createPicture } from "./picture.js";
import { createRun } from "./run.js";
import { createTable } from "./table.js";

const $ = (id) => document.getElementById(id);
const FAR_M = 100000; // from the site: the grid is then about the plan's first place
const HINTS = {
  move: "Drag a point. Drag the small point between two others to add one. Right-click or Delete removes a point.",
  waypoint: "Click where the machine shall drive, in order.",
  fence: "Click the corners; a double click closes the fence. The machine stays inside.",
  "keep-out": "Click the corners; a double click closes the zone. The machine stays outside.",
  landing: "Click where logs shall be unloaded.",
  log: "Click where a log lies; type its bearing and size in the table.",
};
const OPTIONS = [
  { key: "name", label: "name of the mission" },
  { key: "laps", label: "laps", as: whole, hint: "1" },
  { key: "speed_m_s", label: "speed m/s", as: number, hint: "the machine's" },
  { key: "transport_height_m", label: "frame height on the way m", as: number, hint: "the machine's" },
  { key: "loading_height_m", label: "frame height when loading m", as: number, hint: "the machine's" },
  { key: "logs", label: "logs", usual: "search", choices: [["search along the route", "search"], ["also stop at the listed ones", "listed"]] },
  { key: "logs_wanted", label: "end after this many logs", as: whole, hint: "all" },
  { key: "assortments", label: "only these assortments", as: words, hint: "all, or names with commas" },
  { key: "sort_by_assortment", label: "sort to landings by assortment", usual: false, choices: [["no", false], ["yes", true]] },
];

let frame = createFrame(0, 0), site = [0, 0], map = null, table = null, check = null;

const header = { run: null };
const ready = createHeader({ show: (state) => header.run?.show(state), lost: () => header.run?.lost() });

const model = createModel((what) => {
  if (!map) return;
  if (what === "mission") {
    map.draw();
    table.draw();
    check.ask(model.mission);
    showOptions();
  } else {
    map.drawChoice();
    table.follow();
  }
  buttons();
});

const options = createFields($("options"), "option", alarm, (field, value) => {
  const next = { ...model.mission };
  if (field.key === "name") next.name = value;
  else next.options = { ...next.options, [field.key]: value ?? (field.key === "laps" ? 1 : null) };
  model.commit(next);
});
const showOptions = () => options.show(OPTIONS, { ...model.mission.options, name: model.mission.name });

function buttons() {
  $("undo").disabled = !model.mayUndo;
  $("redo").disabled = !model.mayRedo;
  $("delete").disabled = !model.chosen;
}

/** The grid is about the site, or about the plan's first place if that is far away. */
function place() {
  frame = createFrame(...site);
  const first = allPlaces(model.mission)[0];
  if (first && !(Math.hypot(...frame.local(first)) < FAR_M)) {
    const sane = Math.abs(first.latitude_deg) <= 90 && Math.abs(first.longitude_deg) <= 180;
    if (sane) frame = createFrame(first.latitude_deg, first.longitude_deg);
  }
}

function refit() {
  place();
  map.draw();
  table.draw();
  map.fit();
}

function use(tool) {
  for (const b of document.querySelectorAll("[data-tool]")) b.setAttribute("aria-pressed", b.dataset.tool === tool);
  $("tool-hint").textContent = HINTS[tool];
  map.use(tool);
}

function remove() {
  if (!model.chosen) return;
  model.commit(without(model.mission, model.chosen));
  model.choose(null);
}

window.addEventListener("keydown", (event) => {
  if (event.target instanceof Element && event.target.closest("input, select, textarea")) return;
  const command = event.ctrlKey || event.metaKey;
  if (command && event.key.toLowerCase() === "z") event.shiftKey ? model.redo() : model.undo();
  else if (command && event.key.toLowerCase() === "y") model.redo();
  else if (event.key === "Delete" || event.key === "Backspace") remove();
  else if (event.key === "Enter" && !event.target.closest("button, a")) map?.close();
  else return;
  event.preventDefault();
});

async function start() {
  // STOP is connected above and works even if everything below fails.
  await ready;
  const settings = await (await fetch("api/plan/settings")).json();
  $("title").textContent = `Plan a mission · ${settings.machine}`;
  if (!settings.site) throw new Error(`${settings.profile} does not drive; start the console with a machine that has a carrier`);
  site = settings.site;
  place();
  map = createMap($("plan-map"), model, () => frame);
  table = createTable(model, () => frame, alarm);
  check = createCheck({
    choose: (part) => map.show(part),
    found: (findings) => map.marks(findings),
    exchange: (parts) => { model.commit(exchanged(model.mission, parts)); refit(); },
  });
  const files = createFiles(model, refit), run = createRun(model, files);
  createPicture(map.grid, alarm);
  files.begin(settings);
  run.begin(settings);
  header.run = run;
  for (const b of document.querySelectorAll("[data-tool]")) b.addEventListener("click", () => use(b.dataset.tool));
  $("undo").addEventListener("click", () => model.undo());
  $("redo").addEventListener("click", () => model.redo());
  $("delete").addEventListener("click", remove);
  $("fit").addEventListener("click", refit);
  use("move");
  showOptions();
  buttons();
  refit();
  check.ask(model.mission);
  if (!settings.may_plan) alarm("Missions are checked and saved by operators only.", Infinity);
  document.body.dataset.ready = "yes";
  window.plan = { model, map }; // for tests and the browser's console
}

start().catch((error) => alarm(`The page could not start: ${error.message}.`, Infinity));
