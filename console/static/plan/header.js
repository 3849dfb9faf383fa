// The header of the pages beside the machine's: the controller's mode, the STOP button and keys, and this page's part of the watch.

import { post, socketAddress, beginAccess } from "../access.js";
import { createHeartbeat } from "../heartbeat.js";
import { createLease } from "../lease.js";
import { createStop } from "../stop.js";

const LOST_AFTER_MS = 700;
const MODE_WORDS = { STOP: "STOPPED" };
const MODE_MARKS = { BOOT: "◌", STANDBY: "○", ARMED: "◆", ACTIVE: "▶", STOP: "■", FAULT: "✖" };
const $ = (id) => document.getElementById(id);

let alarmUntil = 0;

export function alarm(text, holdMs = 10000) {
  $("alarm").textContent = text;
  $("alarm").hidden = false;
  alarmUntil = performance.now() + holdMs;
}

export async function sendMission(name) {
  try {
    const answer = await post(`api/mission/${name}`, { signal: AbortSignal.timeout(2000) });
    if (!answer.ok) throw new Error((await answer.text()) || answer.statusText);
  } catch (error) {
    alarm(`${name.toUpperCase()} could not be sent (${error.message}). No action was taken.`);
  }
}

/** Connects STOP at once, then the state; `show(state)` follows each state, `lost()` a broken
 * connection.  Returns a promise: this page has its token. */
export function createHeader({ show, lost }) {
  createStop($("stop"), alarm, () => {
    for (const open of document.querySelectorAll("dialog[open]")) open.close();
  });

  const heartbeat = createHeartbeat();
  let lastMessage = -Infinity, state = null, lease = null;

  function connect() {
    const socket = new WebSocket(socketAddress());
    socket.addEventListener("message", (event) => {
      lastMessage = performance.now();
      state = JSON.parse(event.data);
      heartbeat.answer(socket, state);
      $("stop").disabled = !state.may_stop;
      lease.show(state);
      show(state);
    });
    socket.addEventListener("close", () => setTimeout(begin, 500));
  }

  function watch() {
    const now = performance.now(), linked = now - lastMessage < LOST_AFTER_MS;
    const known = linked && state.alive && state.mode;
    document.body.dataset.mode = known ? state.mode : "";
    $("mode").textContent = known ? (MODE_WORDS[state.mode] ?? state.mode) : "NO CONNECTION";
    $("mode-mark").textContent = known ? (MODE_MARKS[state.mode] ?? "?") : "○";
    if (!linked) lost();
    if (now < alarmUntil) return;
    $("alarm").hidden = linked || lastMessage < 0;
    if (!linked) $("alarm").textContent = "No connection to the console server: the display is outdated, and nothing can be saved.";
  }

  async function begin() {
    const me = await beginAccess();
    lease ??= createLease($("lease"), alarm, me);
    connect();
  }
  const ready = begin();
  setInterval(watch, 100);
  return ready;
}
