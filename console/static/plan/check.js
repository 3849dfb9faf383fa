// The check while drawing: asks the server a moment after each change, and shows errors, warnings, time and wood.

import { post } from "../access.js";

const $ = (id) => document.getElementById(id);
const WAIT_MS = 300;

/** `choose(part)` shows a part; `found(findings)` follows each answer; returns `{ask(mission)}`. */
export function createCheck({ choose, found, exchange }) {
  let timer = 0, asked = 0, last = { errors: [], warnings: [] };

  function ask(mission) {
    clearTimeout(timer);
    asked += 1;
    state("checking …");
    timer = setTimeout(() => send(mission, asked), WAIT_MS);
  }

  async function send(mission, number) {
    try {
      const answer = await post("api/plan/check", { body: JSON.stringify(mission) });
      if (!answer.ok) throw await refusalOf(answer);
      const told = await answer.json();
      if (number === asked) show(told);
    } catch (error) {
      if (number === asked) state(`not checked: ${error.message}`);
    }
  }

  function state(words, kind = "") {
    $("check-state").textContent = words;
    $("check-state").dataset.kind = kind;
  }

  function show(told) {
    last = told;
    const { errors, warnings, estimate, wood } = told;
    if (errors.length) state(`${counted(errors.length, "error")}: cannot be driven`, "error");
    else if (warnings.length) state(`can be driven, ${counted(warnings.length, "warning")}`, "warning");
    else state("can be driven, no warnings", "good");
    const items = [...errors.map((f) => entry(f, "error")), ...warnings.map((f) => entry(f, "warning"))];
    $("findings").replaceChildren(...items);
    $("exchange").hidden = !swapped(told).length;
    text("duration", estimate ? minutes(estimate.total_s) : "–");
    text("driving", estimate ? minutes(estimate.drive_s) : "–");
    text("loading", estimate ? minutes(estimate.crane_s) : "–");
    text("length", estimate ? `${estimate.length_m.toFixed(0)} m` : "–");
    text("to-load", estimate ? String(estimate.logs) : "–");
    text("wood", wood.logs ? `${wood.volume_m3.toFixed(2)} m³` : "–");
    $("wood").title = wood.logs ? `${counted(wood.logs, "log")}, ${wood.unsized} without a size` : "";
    found([...errors.map((f) => ({ ...f, kind: "error" })), ...warnings.map((f) => ({ ...f, kind: "warning" }))]);
  }

  function entry(finding, kind) {
    const item = document.createElement("li"), button = item.appendChild(document.createElement("button"));
    item.className = kind;
    button.type = "button";
    button.append(mark(kind), ` ${finding.sentence}`);
    button.disabled = !finding.part;
    button.addEventListener("click", () => choose(finding.part));
    return item;
  }

  $("exchange").addEventListener("click", () => {
    const parts = swapped({ errors: last.errors, warnings: [] }).map((f) => f.part);
    exchange(parts.length && parts.every(Boolean) ? parts : null);
  });
  return { ask };
}

function swapped({ errors, warnings }) {
  return [...errors, ...warnings].filter((f) => f.code === "mission.swapped-axes" || f.sentence.includes("look swapped"));
}

export const MARKS = { error: "✖", warning: "▲" };

function mark(kind) {
  const element = document.createElement("b");
  element.textContent = MARKS[kind];
  element.setAttribute("aria-label", kind);
  return element;
}

/** Why a request was refused: an error with the sentence and, of a mission, its code. */
export async function refusalOf(answer) {
  const body = await answer.text();
  let told = {};
  try { told = JSON.parse(body); } catch { /* a sentence alone */ }
  return Object.assign(new Error(told.sentence ?? (body || answer.statusText)), { code: told.code });
}

const counted = (n, what) => `${n} ${what}${n === 1 ? "" : "s"}`;
const minutes = (s) => s >= 7200 ? `${(s / 3600).toFixed(1)} h` : `${(s / 60).toFixed(s < 600 ? 1 : 0)} min`;
const text = (id, value) => { $(id).textContent = value; };
