// A recorded run in the page: play, pause, speed, and a bar to scrub, under a strip of modes and stops.

import { drawStrip } from "./timeline.js";

const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];
const BEFORE_STOP_S = 10, SEEK_EVERY_MS = 60;

/** Fills `container`; returns `{connected(socket), show(state), pick(entry), key(event)}`. */
export function createReplay(container, recording) {
  const length = recording.end_s - recording.begin_s;
  let socket = null, at = null, playing = false, entries = [], held = false, sentMs = 0, later = 0;
  document.body.dataset.recording = "yes";
  container.hidden = false;

  const head = make("p", "what");
  head.append(make("b", "", "RECORDING"), ` ${recording.name}`);
  if (recording.note) head.append(make("span", "note", recording.note));
  const strip = make("div", "strip"), bar = make("input", "scrub");
  strip.setAttribute("aria-hidden", "true");
  Object.assign(bar, { type: "range", min: 0, max: length, step: 0.02, value: 0 });
  bar.setAttribute("aria-label", "Time of the recording");
  const track = make("div", "track");
  track.append(strip, bar);

  const play = button("▶ Play", () => send(playing ? "pause" : "play"));
  const before = button("◀ Stop", () => jump(-1)), after = button("Stop ▶", () => jump(1));
  before.setAttribute("aria-label", "10 s before the previous stop");
  after.setAttribute("aria-label", "10 s before the next stop");
  const back = button("−10 s", () => seek(at - 10)), on = button("+10 s", () => seek(at + 10));
  const speed = make("select");
  for (const each of SPEEDS) speed.append(new Option(`${each} ×`, each, each === 1, each === 1));
  const speedLabel = make("label", "", "speed ");
  speedLabel.append(speed);
  const clock = make("output", "clock");
  const row = make("div", "row");
  row.append(play, back, on, before, after, speedLabel, clock);
  container.append(head, track, row);

  speed.addEventListener("change", () => send(`speed ${speed.value}`));
  bar.addEventListener("input", () => { held = true; seek(recording.begin_s + Number(bar.value)); });
  bar.addEventListener("change", () => { held = false; seek(recording.begin_s + Number(bar.value), true); });

  function make(name, className = "", words = "") {
    const element = document.createElement(name);
    if (className) element.className = className;
    element.textContent = words;
    return element;
  }

  function button(words, act) {
    const element = make("button", "", words);
    element.type = "button";
    element.addEventListener("click", act);
    return element;
  }

  function send(words) {
    if (socket?.readyState === WebSocket.OPEN) socket.send(words);
  }

  /** At most some seeks a second while the bar is dragged; the last one always. */
  function seek(seconds, now = false) {
    at = Math.min(Math.max(seconds, recording.begin_s), recording.end_s);
    tell();
    clearTimeout(later);
    const wait = now ? 0 : sentMs + SEEK_EVERY_MS - performance.now();
    const go = () => { sentMs = performance.now(); send(`seek ${at.toFixed(6)}`); };
    if (wait <= 0) go(); else later = setTimeout(go, wait);
  }

  function pick(entry) {
    seek(entry.at_s - (entry.kind === "stop" ? BEFORE_STOP_S : 1), true);
    if (entry.kind === "stop") send("play");
  }

  function jump(direction) {
    const stops = entries.filter((e) => e.kind === "stop"), here = at + BEFORE_STOP_S;
    const found = direction > 0 ? stops.find((e) => e.at_s > here + 0.5) : stops.findLast((e) => e.at_s < here - 2);
    if (found) pick(found);
  }

  function tell() {
    const seconds = at - recording.begin_s;
    if (!held) bar.value = seconds;
    clock.value = `${seconds.toFixed(1)} s of ${length.toFixed(1)} s`;
    bar.setAttribute("aria-valuetext", clock.value);
  }

  async function recall() {
    const answer = await fetch("api/timeline");
    if (!answer.ok) return;
    entries = await answer.json();
    drawStrip(strip, entries, recording.begin_s, recording.end_s);
    before.disabled = after.disabled = !entries.some((e) => e.kind === "stop");
  }

  return {
    pick,
    connected(open) {
      socket = open;
      recall();
      if (at !== null) send(`seek ${at.toFixed(6)}`); // after a lost connection
    },
    show(state) {
      if (!state.replay) return;
      playing = state.replay.playing;
      const words = playing ? "❚❚ Pause" : "▶ Play";
      if (play.textContent !== words) play.textContent = words;
      if (held || performance.now() - sentMs < 250) return; // the answer to the last seek is on its way
      at = state.replay.at_s;
      if (document.activeElement !== speed) speed.value = state.replay.speed;
      tell();
    },
    key(event) {
      if (event.key !== " " || event.target.closest("input[type=search], select")) return;
      event.preventDefault();
      event.stopPropagation();
      if (!event.repeat) send(playing ? "pause" : "play");
    },
  };
}
