// Mission and vehicle in text and numbers, and the mission commands.  Shown after the first mission report.

import { createMap } from "./map.js";

const $ = (id) => document.getElementById(id);
const COMMANDS = { auto: "auto", pause: "pause", "next-step": "next-step" };
const ARMS = ["front left", "front right", "rear left", "rear right"];

/** `send(name)` sends a mission command; returns `{show(state), recall()}`. */
export function createMission(machine, send, { number, text }) {
  let map = null, mission = null;

  for (const [id, name] of Object.entries(COMMANDS)) $(id).addEventListener("click", () => send(name));
  $("single").addEventListener("click", () => send(mission?.single_step ? "run-through" : "single-step"));
  $("abort").addEventListener("click", () => { $("end").show(); $("end-no").focus(); });
  $("end-no").addEventListener("click", () => $("end").close());
  $("end-yes").addEventListener("click", () => { $("end").close(); send("abort"); });

  function begin() {
    document.body.dataset.mission = "there";
    for (const id of ["vehicle", "site"]) $(id).hidden = false;
    const buttons = [...document.querySelectorAll("[data-map]")];
    const press = (name) => buttons.forEach((b) => b.setAttribute("aria-pressed", b.dataset.map === name));
    map = createMap($("map"), machine, () => press(""));
    for (const b of buttons) b.addEventListener("click", () => { press(b.dataset.map); map.view(b.dataset.map); });
    recall();
  }

  /** The track driven before this page was opened or while it was disconnected. */
  async function recall() {
    const answer = await fetch("api/trail");
    if (answer.ok) map?.trail(await answer.json());
  }

  function show(state) {
    if (state.mission) {
      mission = state.mission;
      $("mission").hidden = false;
    }
    // A recording has the vehicle's track, but no mission reports.
    if (!map && (mission || machine.recording?.moves)) begin();
    if (!map) return;
    if (mission) showCommands(state);
    map.mission(mission, state.mission_alive || !mission);
    map.crane(state.points ?? null);
    map.vehicle(state.vehicle);
    showVehicle(state.vehicle);
    $("site").classList.toggle("old", !state.mission_alive && !state.vehicle?.place_alive);
  }

  function showCommands(state) {
    if (state.mission) showMission(mission);
    const m = mission, current = state.mission_alive, may = current && !m.ended && state.may_order, open = may && state.lease.mine;
    $("mission").classList.toggle("old", !current);
    text("mission-age", current ? m.name : `last report ${age(state.mission_age_s)} ago`);
    text("mission-note", note(m, current));
    $("auto").disabled = !open || m.auto;
    $("pause").disabled = !may || !m.auto;
    $("single").disabled = $("abort").disabled = !open;
    $("next-step").disabled = !open || !m.waits_for || !m.auto;
    $("single").setAttribute("aria-pressed", m.single_step);
    if (!open && $("end").open) $("end").close();
  }

  function showMission(m) {
    const doing = m.crane && !m.ended ? `${m.words}: ${m.crane}` : m.words;
    text("mission-words", `The machine ${doing}.`);
    text("on-board", `${m.on_board} · ${number(m.on_board_m3, 2)} m³`);
    text("loaded", String(m.loaded));
    text("unloaded", String(m.unloaded));
    text("driven", `${number(m.driven_m, 0)} m`);
    text("known", String(m.logs.filter((log) => !log.given_up).length));
    text("target", m.targets.length ? `log ${m.targets.join(", ")}` : "–");
    text("missed-grasps", String(m.missed));
    const left = m.given_up.map((g) => `Log ${g.log} given up: ${g.reason}.`);
    if ($("given-up").dataset.shown !== left.join()) {
      $("given-up").dataset.shown = left.join();
      $("given-up").replaceChildren(...left.map((sentence) => Object.assign(document.createElement("li"), { textContent: sentence })));
    }
  }

  function note(m, current) {
    if (!current) return m.ended ? "The mission has ended." : "No report from the planner: the display is outdated.";
    if (m.ended) return m.failure ? `The mission failed: ${m.failure}.` : "";
    if (m.refusal) return `Command refused: ${m.refusal}.`;
    if (!m.auto) return "Paused. Press Auto to resume.";
    if (m.paused) return `Paused: ${m.paused}.`;
    if (m.waits_for) return `Ready for the next step: ${m.waits_for}. Press Next step.`;
    return "";
  }

  function showVehicle(v) {
    $("vehicle").classList.toggle("old", !v?.alive);
    text("vehicle-age", !v ? "no report yet" : v.alive ? v.driving : `last report ${age(v.age_s)} ago`);
    if (!v) return;
    text("speed", v.speed_m_s === null ? "–" : `${number(v.speed_m_s * 3.6, 1)} km/h`);
    text("heading", v.heading_deg === null ? "–" : `${number((v.heading_deg + 360) % 360, 0)}°`);
    text("bend", sided(v.articulation_deg, "left", "right"));
    text("roll", sided(v.roll_deg, "right", "left"));
    text("pitch", sided(v.pitch_deg, "up", "down"));
    text("fix", v.sigma_m === null ? v.fix : `${v.fix}, ±${number(v.sigma_m * 100, 0)} cm`);
    const limit = (machine.carrier.tilt_limit_rad * 180) / Math.PI;
    for (const [id, value] of [["roll", v.roll_deg], ["pitch", v.pitch_deg]]) {
      $(id).classList.toggle("warn", value !== null && Math.abs(value) > 0.8 * limit);
    }
    v.heights_m.forEach((h, i) => {
      $(`arm-${i}`).title = ARMS[i];
      text(`arm-${i}`, h === null ? "–" : `${number(h * 100, 0)} cm`);
    });
    text("vehicle-note", v.stale.length ? `Outdated inputs: ${v.stale.join(", ")}.` : "");
  }

  function sided(degrees, plus, minus) {
    if (degrees === null) return "–";
    const shown = number(Math.abs(degrees), 1);
    return shown === "0.0" ? "0.0°" : `${shown}° ${degrees > 0 ? plus : minus}`;
  }

  function age(seconds) {
    return seconds < 100 ? `${number(seconds, 0)} s` : `${number(seconds / 60, 0)} min`;
  }

  return { show, recall: () => { if (map) recall(); } };
}
