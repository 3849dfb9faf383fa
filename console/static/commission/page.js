// The commissioning page: commands, steps of joints, calibration; the protocol is in protocol.js.

import { post } from "../access.js";
import { alarm, createHeader } from "../plan/header.js";
import { createCharts } from "./charts.js";
import { showFound } from "./found.js";
import { createProtocol } from "./protocol.js";

const $ = (id) => document.getElementById(id);
const POLL_MS = 300, DEGREES = 180 / Math.PI;
let joints = [], charts = null, protocol = null, drawn = "", leads = false, technician = false, busy = false;

const ready = createHeader({ show, lost: () => {} });

// ---- commands

async function send(path, body) {
  try {
    const answer = await post(path, { body: body && JSON.stringify(body), signal: AbortSignal.timeout(20000) });
    if (!answer.ok) throw new Error((await answer.text()) || answer.statusText);
    return true;
  } catch (error) { alarm(error.message); }
  return false;
}

// Not modal: a modal dialog would disable STOP.
function ask(title, words, button, then) {
  $("confirm-title").textContent = title;
  $("confirm-words").textContent = words;
  $("confirm-yes").textContent = button;
  $("confirm-yes").onclick = () => { $("confirm").close(); then(); };
  $("confirm").show();
  $("confirm-no").focus();
}
$("confirm-no").addEventListener("click", () => $("confirm").close());

$("arm").addEventListener("click", () => ask("Arm the crane?",
  "Once armed, the crane moves as soon as a step or the calibration begins. Nobody may be within its reach. Keep the hard-wired emergency stop within yours.",
  "Area is clear: ARM", () => send("api/operator/arm")));
$("disarm").addEventListener("click", () => send("api/operator/disarm"));
$("reset").addEventListener("click", () => send("api/operator/reset"));
$("end").addEventListener("click", () => send("api/commission/end"));
$("step-form").addEventListener("submit", (event) => {
  event.preventDefault();
  const joint = chosen(), typed = Number($("amount").value);
  send("api/commission/step", { joint: joint.name, amount: joint.unit === "m" ? typed / 1000 : typed / DEGREES });
});
$("calibrate").addEventListener("click", () => ask("Calibrate the crane?",
  `It waits until the machine is armed, and then moves one function after the other for ${$("calibrated").value ? "a minute" : "four minutes"}. Clear the zone: no person and no log within reach, the grapple empty, the ground level, the oil warm.`,
  "Area is clear: calibrate", () => {
    const one = $("calibrated").value;
    send("api/commission/calibrate", { joints: one ? [one] : [] });
  }));

// ---- display

function show(state) {
  leads = state.lease.mine;
  technician = state.role === "technician";
  $("arm").disabled = $("reset").disabled = !(state.may_command && leads);
  $("disarm").disabled = !state.may_command;
  buttons();
}

function buttons() {
  const may = leads && technician && !busy;
  $("step").disabled = !may || !chosen()?.senses;
  $("calibrate").disabled = !may;
  $("end").disabled = !busy;
  $("save").disabled = !technician;
}

const chosen = () => joints.find((j) => j.name === $("joint").value);

function choose() {
  const joint = chosen(), metres = joint.unit === "m", largest = joint.largest * (metres ? 1000 : DEGREES);
  $("unit").textContent = `${metres ? "mm" : "°"}, at most ${largest.toFixed(metres ? 0 : 1)}`;
  $("amount").max = largest.toFixed(3);
  $("amount").min = (-largest).toFixed(3);
  $("amount").value = (largest / 2).toFixed(metres ? 0 : 1);
  text("margins", `${joint.phase_deg.toFixed(0)}° · ${joint.gain_db.toFixed(1)} dB`);
  drawn = "";
  buttons();
}

async function poll() {
  try {
    const answer = await fetch("api/commission/state");
    if (answer.ok) follow(await answer.json());
  } catch { /* the header tells of a lost connection */ }
  setTimeout(poll, POLL_MS);
}

function follow(told) {
  if (busy !== told.busy) { busy = told.busy; buttons(); }
  const calibrates = told.doing === "calibration", percent = `${(100 * told.share).toFixed(0)} %`;
  const left = told.left_s === null ? "" : `, about ${told.left_s} s left`;
  const words = !told.doing ? "Take control, choose a joint, press Step, then arm."
    : told.busy ? (told.waiting ? `The ${told.doing} waits: ${told.waiting}.` : `The ${told.doing} runs: ${percent}${left}.`)
    : told.failure ? `The ${told.doing} has ended early: ${told.failure}` : `The ${told.doing} is done.`;
  text("doing", words);
  text("said", calibrates ? told.failure || told.said : "");
  for (const id of ["doing", "said"]) $(id).classList.toggle("bad", Boolean(told.failure) && !told.busy);
  $("share").value = told.busy ? told.share : told.doing && !told.failure ? 1 : 0;
  showFound(told.found);
  protocol.measured(told.steps, joints);
  const joint = chosen(), step = told.steps[joint.name], key = `${joint.name} ${step?.at ?? ""}`;
  if (key === drawn) return;
  drawn = key;
  figures(joint, step?.figures);
  charts.draw(joint, step);
}

function figures(joint, found) {
  const way = (v) => (v === null ? "–" : joint.unit === "m" ? `${(v * 1000).toFixed(1)} mm` : `${(v * DEGREES).toFixed(2)}°`);
  text("largest-error", found ? way(found.largest_error) : "–");
  text("rest-error", found ? way(found.rest_error) : "–");
  text("overshoot", found ? way(found.overshoot) : "–");
  text("delay", found && found.delay_s !== null ? `${(found.delay_s * 1000).toFixed(0)} ms` : "–");
  text("command", found && found.largest_command_pct !== null ? `${found.largest_command_pct.toFixed(0)} %` : "–");
}

function text(id, words) {
  if ($(id).textContent !== words) $(id).textContent = words;
}

async function start() {
  await ready;
  const settings = await (await fetch("api/commission/settings")).json();
  joints = settings.joints;
  $("title").textContent = `Commission · ${settings.machine}`;
  $("joint").replaceChildren(...joints.map((j) => new Option(j.senses ? j.name : `${j.name} (no encoder)`, j.name)));
  $("joint").addEventListener("change", choose);
  const tested = joints.filter((j) => j.senses).map((j) => new Option(`only ${j.name}`, j.name));
  $("calibrated").replaceChildren(new Option("every joint, and the grapple", ""), ...tested);
  charts = createCharts($("way"), $("valve"), $("way-unit"));
  protocol = createProtocol(settings, alarm);
  choose();
  charts.draw(chosen());
  poll();
  document.body.dataset.ready = "yes";
}

start().catch((error) => alarm(`The page could not start: ${error.message}.`, Infinity));
