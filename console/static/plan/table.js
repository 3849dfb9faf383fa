// The parts of the mission as a table in metres and degrees, and the other properties of the chosen part.

import { LISTS, added, allPlaces, moved, withItem } from "./model.js";
import { createFields, number, whole, words } from "./fields.js";

const $ = (id) => document.getElementById(id);
const MOST_ROWS = 200, ROUND_M = 10;
const DETAILS = {
  waypoint: [],
  fence: [
    { key: "name", label: "name" },
    { key: "keep_out", label: "the machine stays", choices: [["inside: fence", false], ["outside: exclusion zone", true]] },
  ],
  landing: [
    { key: "name", label: "name" },
    { key: "bearing_deg", label: "bearing of its logs °", as: number },
    { key: "assortments", label: "assortments, with commas", as: words },
  ],
  log: [
    { key: "key", label: "key" }, { key: "bearing_deg", label: "bearing °", as: number },
    { key: "length_m", label: "length m", as: number }, { key: "diameter_m", label: "diameter m", as: number },
    { key: "species", label: "species" }, { key: "assortment", label: "assortment" },
    { key: "sigma_m", label: "position ± m", as: number }, { key: "product_key", label: "product key", as: whole },
  ],
};
const EMPTY = { waypoint: "No waypoints", fence: "No fences", landing: "No landings", log: "No logs" };

/** `model` and `frame`: see map.js; `complain(sentence)` says why a typed value is not taken. */
export function createTable(model, frame, complain) {
  let tab = "waypoint", fence = 0, first = 0, shape = "";
  const rows = $("parts").tBodies[0];
  const details = createFields($("details"), "detail", complain, (field, value) => {
    const part = detailed();
    model.commit(withItem(model.mission, part, { ...model.mission[LISTS[part[0]]][part[1]], [field.key]: value }));
  });

  for (const button of document.querySelectorAll("[data-tab]")) {
    button.addEventListener("click", () => { tab = button.dataset.tab; draw(); });
  }
  $("fence-choice").addEventListener("change", () => { fence = +$("fence-choice").value; model.choose(["fence", fence]); draw(); });
  $("add").addEventListener("click", () => (tab === "fence" ? addFence() : addPoint()));
  $("add-corner").addEventListener("click", addCorner);

  function addPoint() {
    const list = model.mission[LISTS[tab]], last = tab === "waypoint" ? list.at(-1) : list.at(-1)?.position;
    const [east, north] = last ? frame().local(last) : [0, 0];
    model.commit(added(model.mission, tab, frame().point(last ? east + 5 : 0, north)));
    model.choose([tab, model.mission[LISTS[tab]].length - 1]);
    rows.lastElementChild?.querySelector("input")?.focus();
  }

  /** A rectangle round the whole plan, to be moved or typed. */
  function addFence() {
    const places = allPlaces(model.mission).map((p) => frame().local(p));
    const [east, north] = [0, 1].map((axis) => (places.length ? places.map((p) => p[axis]) : [0]));
    const [low, high] = [[east, north].map((v) => Math.min(...v) - ROUND_M), [east, north].map((v) => Math.max(...v) + ROUND_M)];
    const ring = [low, [high[0], low[1]], high, [low[0], high[1]]].map((corner) => frame().point(...corner));
    const fences = [...model.mission.fences, { corners: ring, keep_out: false, name: "" }];
    model.commit({ ...model.mission, fences });
    model.choose(["corner", fences.length - 1, 0]);
  }

  /** A corner half way to the next one, after the chosen corner or the last. */
  function addCorner() {
    const item = model.mission.fences[fence], { chosen } = model;
    const j = chosen?.[0] === "corner" && chosen[1] === fence ? chosen[2] : item.corners.length - 1;
    const [a, b] = [j, (j + 1) % item.corners.length].map((k) => frame().local(item.corners[k]));
    const middle = frame().point((a[0] + b[0]) / 2, (a[1] + b[1]) / 2);
    const corners = [...item.corners.slice(0, j + 1), middle, ...item.corners.slice(j + 1)];
    model.commit(withItem(model.mission, ["fence", fence], { ...item, corners }));
    model.choose(["corner", fence, j + 1]);
  }

  const points = () => ({
    waypoint: () => model.mission.waypoints.map((p, i) => [["waypoint", i], p]),
    fence: () => (model.mission.fences[fence]?.corners ?? []).map((p, j) => [["corner", fence, j], p]),
    landing: () => model.mission.landings.map((x, i) => [["landing", i], x.position]),
    log: () => model.mission.logs.map((x, i) => [["log", i], x.position]),
  })[tab]();

  /** The part whose details are shown: the chosen one, of fences also the fence of a corner. */
  function detailed() {
    const { chosen } = model;
    if (tab === "fence") return model.mission.fences[fence] ? ["fence", fence] : null;
    return chosen?.[0] === tab ? chosen : null;
  }

  function draw() {
    const { mission } = model;
    fence = Math.min(fence, Math.max(0, mission.fences.length - 1));
    for (const b of document.querySelectorAll("[data-tab]")) {
      b.setAttribute("aria-pressed", b.dataset.tab === tab);
      const count = mission[LISTS[b.dataset.tab]].length;
      b.textContent = `${b.dataset.tab[0].toUpperCase()}${b.dataset.tab.slice(1)}s${count ? ` ${count}` : ""}`;
    }
    drawFences(mission);
    $("add-corner").hidden = tab !== "fence" || !mission.fences.length;
    $("add").textContent = `Add a ${tab}`;
    const all = points();
    first = firstRow(all);
    const shown = all.slice(first, first + MOST_ROWS);
    const now = `${tab} ${fence} ${first} ${shown.length}`;
    if (now !== shape) rows.replaceChildren(...shown.map(([part]) => row(part)));
    shape = now;
    shown.forEach(([part, point], k) => fill(rows.children[k], part, point));
    $("parts-note").textContent = !all.length ? `${EMPTY[tab]} yet. Draw on the map, or add and type.`
      : all.length > MOST_ROWS ? `${all.length} in all; choose one on the map to see its row.` : "";
    const part = detailed();
    details.show(part ? DETAILS[tab] : [], part ? mission[LISTS[part[0]]][part[1]] : {});
  }

  function firstRow(all) {
    const chosen = all.findIndex(([part]) => String(part) === String(model.chosen));
    if (chosen >= first && chosen < first + MOST_ROWS) return first; // the row that has the keyboard stays
    return chosen < MOST_ROWS ? 0 : chosen - MOST_ROWS / 2;
  }

  function drawFences({ fences }) {
    $("fence-line").hidden = tab !== "fence" || !fences.length;
    $("fence-choice").replaceChildren(...fences.map((f, i) => {
      const words = `${i + 1}: ${f.name || (f.keep_out ? "exclusion zone" : "fence")}`;
      return new Option(words, String(i), false, i === fence);
    }));
  }

  function row(part) {
    const tr = document.createElement("tr");
    tr.insertCell();
    const name = part[0] === "corner" ? `corner ${part[2] + 1}` : `${part[0]} ${part[1] + 1}`;
    ["east, metres", "north, metres", "latitude, degrees", "longitude, degrees"].forEach((what, column) => {
      const input = tr.insertCell().appendChild(document.createElement("input"));
      input.inputMode = "decimal";
      input.autocomplete = "off";
      input.setAttribute("aria-label", `${name}: ${what}`);
      input.addEventListener("change", () => typed(part, input, column));
    });
    tr.addEventListener("focusin", () => model.choose(part));
    tr.addEventListener("click", () => model.choose(part));
    return tr;
  }

  function fill(tr, part, point) {
    const [east, north] = frame().local(point);
    const shown = [east.toFixed(2), north.toFixed(2), point.latitude_deg.toFixed(8), point.longitude_deg.toFixed(8)];
    tr.cells[0].textContent = String(part.at(-1) + 1);
    tr.classList.toggle("chosen", String(part) === String(model.chosen));
    shown.forEach((value, column) => {
      const input = tr.cells[column + 1].firstElementChild;
      input.value = input.dataset.shown = value;
    });
  }

  function typed(part, input, column) {
    const value = number.read(input.value);
    if (value === null || value === undefined) {
      complain(`"${input.value}" is not a number; write 12.5 with a point.`);
      input.value = input.dataset.shown;
      return;
    }
    const index = part.at(-1), before = points()[index][1], [east, north] = frame().local(before);
    const after = column < 2 ? frame().point(column === 0 ? value : east, column === 1 ? value : north)
      : { ...before, [column === 2 ? "latitude_deg" : "longitude_deg"]: value };
    model.commit(moved(model.mission, part, { ...after, altitude_m: before.altitude_m ?? null }));
  }

  /** Shows the tab of the chosen part. */
  function follow() {
    const { chosen } = model;
    if (chosen) {
      tab = chosen[0] === "corner" ? "fence" : chosen[0];
      if (tab === "fence") fence = chosen[1];
    }
    draw();
    const tr = rows.querySelector("tr.chosen"), box = rows.closest(".scroll"); // scrolls the table, never the page
    if (tr) box.scrollTop = Math.min(tr.offsetTop, Math.max(box.scrollTop, tr.offsetTop + tr.offsetHeight - box.clientHeight));
  }
  return { draw, follow };
}
