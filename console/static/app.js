// The operator page: receives the state by websocket, shows it, and sends operator commands by POST.

import { beginAccess, post, socketAddress } from "./access.js";
import { createHeartbeat } from "./heartbeat.js";
import { createLease } from "./lease.js";
import { createMission } from "./mission.js";
import { createPanels } from "./panels.js";
import { createPlot, LINES } from "./plot.js";
import { createReplay } from "./replay.js";
import { createShift } from "./shift.js";
import { createTrueLogs } from "./true_logs.js";

const LOST_AFTER_MS = 700;
const MODE_WORDS = { STOP: "STOPPED" };
const MODE_MARKS = { BOOT: "◌", STANDBY: "○", ARMED: "◆", ACTIVE: "▶", STOP: "■", FAULT: "✖" };
const $ = (id) => document.getElementById(id);

let machine = null;
let scene = null;
let mission = null;
let panels = null;
let replay = null;
let shift = null;
let lease = null;
let rows = [];
let lastMessage = 0;
let reportAlive = false;
let alarmUntil = 0;
let mode = "";
const plot = createPlot($("plot"));
const heartbeat = createHeartbeat();

// ---- commands --------------------------------------------------------------------------------------------

async function send(path, name, otherwise) {
  try {
    const answer = await post(path, { signal: AbortSignal.timeout(2000) });
    if (!answer.ok) throw new Error((await answer.text()) || answer.statusText);
  } catch (error) {
    alarm(`${name.toUpperCase()} could not be sent (${error.message}). ${otherwise}`, 10000);
  }
}

const HARD_WIRED = "Press the hard-wired emergency stop.", NO_ACTION = "No action was taken.";
const command = (action) => send(`api/operator/${action}`, action, action === "stop" ? HARD_WIRED : NO_ACTION);
const sendMission = (name) => send(`api/mission/${name}`, name.replace("-", " "), NO_ACTION);

$("stop").addEventListener("click", () => command("stop"));
$("reset").addEventListener("click", () => command("reset"));
$("disarm").addEventListener("click", () => command("disarm"));
// Not modal: a modal dialog would disable STOP.
$("arm").addEventListener("click", () => { $("confirm").show(); $("confirm-no").focus(); });
$("confirm-no").addEventListener("click", () => $("confirm").close());
$("confirm-yes").addEventListener("click", () => { $("confirm").close(); command("arm"); });
window.addEventListener("keydown", (event) => {
  if (event.key !== "Escape" && event.key !== " ") return;
  if (replay) return replay.key(event); // nothing can be stopped in a recording
  event.preventDefault();
  event.stopPropagation();
  for (const open of document.querySelectorAll("dialog[open]")) open.close();
  if (!event.repeat) command("stop");
}, { capture: true });
// Releasing the space bar clicks a focused button; here it only means STOP.
window.addEventListener("keyup", (event) => { if (event.key === " ") event.preventDefault(); }, { capture: true });

// ---- link ------------------------------------------------------------------------------------------------

function connect() {
  const socket = new WebSocket(socketAddress());
  socket.addEventListener("message", (event) => {
    lastMessage = performance.now();
    const state = JSON.parse(event.data);
    show(state);
    heartbeat.answer(socket, state);
    watch();
  });
  socket.addEventListener("open", () => { mission?.recall(); panels?.connected(socket); replay?.connected(socket); });
  socket.addEventListener("close", () => setTimeout(async () => { await beginAccess(); connect(); }, 500));
}

function watch() {
  const now = performance.now();
  const linked = now - lastMessage < LOST_AFTER_MS;
  const known = linked && reportAlive;
  document.body.dataset.link = known ? "ok" : "lost";
  text("mode", known ? (MODE_WORDS[mode] ?? mode) : "NO CONNECTION");
  text("mode-mark", known ? (MODE_MARKS[mode] ?? "?") : "○");
  if (now < alarmUntil) return;
  if (linked && replay) { $("alarm").hidden = known; if (!known) alarm("The recording has no report of the controller at this time."); }
  else if (!linked) alarm(`No connection to the console server: the display is outdated.${replayHint()}`);
  else if (!mode) alarm("Waiting for the first controller report.");
  else if (!reportAlive) alarm("No report from the controller: the display is outdated.");
  else $("alarm").hidden = true;
}

function replayHint() {
  return machine?.run ? ` If the run has ended, replay it: timberhand console --replay ${machine.run}` : "";
}

function alarm(text, holdMs = 0) {
  $("alarm").textContent = text;
  $("alarm").hidden = false;
  if (holdMs) alarmUntil = performance.now() + holdMs;
}

// ---- display ---------------------------------------------------------------------------------------------

function show(state) {
  reportAlive = state.alive;
  for (const id of ["arm", "reset"]) $(id).disabled = !(state.may_command && state.lease.mine);
  $("disarm").disabled = !state.may_command;
  lease?.show(state);
  $("stop").disabled = !state.may_stop;
  showTiming(state.timing);
  mission?.show(state);
  panels?.show(state);
  replay?.show(state);
  shift?.show(state);
  if (!state.mode) return;
  document.body.dataset.mode = mode = state.mode;
  text("reason", state.reason);
  state.position.forEach((q, j) => showJoint(j, q, state.reference[j]));
  text("opening", number(state.opening_pct, 0));
  text("clamp", number(state.clamp_bar, 0));
  text("load", number(state.load_kg, 0));
  $("opening-bar").style.width = `${state.opening_pct ?? 0}%`;
  $("clamp-bar").style.width = `${Math.min(100, (100 * (state.clamp_bar ?? 0)) / machine.hold_pressure_bar)}%`;
  text("tick", number(state.tick_ms, 2));
  text("late", number(state.late_ms, 2));
  text("missed", String(state.missed_ticks));
  text("rate", number(state.frames_per_s, 0));
  text("refused", String(state.refused));
  text("operator-link", state.operator_link);
  text("stale", state.stale.length ? state.stale.join(", ") : "none");
  text("refusal", state.refusal ? `Last refused setpoint: ${state.refusal}` : "");
  if (state.history) plot.load(state.history);
  if (state.alive) {
    plot.add(state.time_s, state.position.map((q, j) => {
      const r = state.reference[j];
      return q === null || r === null ? null : (r - q) * 1000;
    }));
  }
  scene?.update(state);
}

function showJoint(j, q, reference) {
  const spec = machine.joints[j], row = rows[j];
  const share = (v) => `${Math.min(100, Math.max(0, (100 * (v - spec.lower)) / (spec.upper - spec.lower)))}%`;
  row.mark.hidden = q === null;
  row.notch.hidden = reference === null;
  if (q !== null) row.mark.style.left = share(q);
  if (reference !== null) row.notch.style.left = share(reference);
  const margin = 0.01 * (spec.upper - spec.lower);
  row.tr.classList.toggle("limit", q !== null && (q < spec.lower + margin || q > spec.upper - margin));
  row.position.textContent = human(spec, q);
  row.error.textContent = q === null || reference === null ? "–" : error(spec, reference - q);
}

function showTiming(timing) {
  $("timing").hidden = !timing;
  if (!timing) return;
  text("wake", number(timing.wake_us, 0));
  text("cpu", number(timing.cpu_us, 0));
  text("sample", number(timing.sample_to_command_ms, 1));
  text("missed-share", `${timing.missed} of ${timing.ticks + timing.missed}`);
  text("oldest-input", timing.oldest_input ? `${number(timing.oldest_input_ms, 1)} ms ${timing.oldest_input}` : "–");
}

function human(spec, value) {
  if (value === null) return "–";
  return spec.kind === "prismatic" ? `${fixed(value, 3)} m` : `${fixed((value * 180) / Math.PI, 1)}°`;
}

function error(spec, value) {
  return spec.kind === "prismatic" ? `${fixed(value * 1000, 0)} mm` : `${fixed((value * 180) / Math.PI, 2)}°`;
}

/** A fixed number of digits, without a minus sign before zero. */
function fixed(value, digits) {
  const shown = value.toFixed(digits);
  return (Number(shown) === 0 ? Math.abs(Number(shown)).toFixed(digits) : shown).replace("-", "−");
}

function number(value, digits) {
  return value === null ? "–" : fixed(value, digits);
}

function text(id, value) {
  const element = $(id);
  if (element.textContent !== value) element.textContent = value;
}

function build() {
  text("title", machine.title);
  document.title = `timberhand · ${machine.name}`;
  rows = machine.joints.map((spec) => {
    const tr = document.createElement("tr");
    const cells = [0, 1, 2, 3].map(() => tr.appendChild(document.createElement("td")));
    cells[0].append(`${spec.name} `);
    cells[0].appendChild(document.createElement("small")).textContent = spec.part;
    const bar = cells[1].appendChild(document.createElement("div"));
    bar.className = "bar";
    if (spec.lower < 0 && spec.upper > 0) {
      bar.appendChild(document.createElement("s")).style.left = `${(-100 * spec.lower) / (spec.upper - spec.lower)}%`;
    }
    const mark = bar.appendChild(document.createElement("i"));
    const notch = bar.appendChild(document.createElement("b"));
    mark.hidden = notch.hidden = true;
    cells[2].textContent = cells[3].textContent = "–";
    document.querySelector("#joints tbody").appendChild(tr);
    return { tr, mark, notch, position: cells[2], error: cells[3] };
  });
  machine.joints.forEach((spec, j) => {
    const item = document.createElement("span");
    item.innerHTML = '<svg width="26" height="8"><line x1="0" y1="4" x2="26" y2="4" stroke-width="2"/></svg>';
    item.querySelector("line").setAttribute("class", `joint-${j}`);
    item.querySelector("line").setAttribute("stroke-dasharray", LINES[j].join(" "));
    item.append(spec.name);
    $("plot-legend").appendChild(item);
  });
}

async function start() {
  // STOP is connected above and works even if everything below fails.
  const me = await beginAccess();
  machine = await (await fetch("api/machine")).json();
  build();
  $("commission-link").hidden = !machine.commissions;
  $("plan-link").hidden = !machine.carrier || Boolean(machine.recording);
  if (machine.recording) replay = createReplay($("replay"), machine.recording);
  else lease = createLease($("lease"), alarm, me);
  panels = createPanels(machine, replay?.pick);
  if (machine.carrier) mission = createMission(machine, sendMission, { number, text });
  if (!machine.recording) shift = createShift(machine, send, { number, text });
  if (machine.truth) createTrueLogs(() => scene, alarm);
  connect();
  setInterval(watch, 100);
  try {
    const { createScene } = await import("./scene.js");
    scene = createScene($("scene"), machine);
    for (const button of document.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => {
        document.querySelectorAll("[data-view]").forEach((b) => b.setAttribute("aria-pressed", b === button));
        scene.view(button.dataset.view);
      });
    }
  } catch (error) {
    const note = document.createElement("p");
    note.textContent = `The 3-D view needs WebGL and is not available here (${error.message}). Everything else works.`;
    $("scene").replaceChildren(note);
  }
}

start().catch((error) => alarm(`The page could not start: ${error.message}`, Infinity));
