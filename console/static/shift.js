// The numbers of a shift.  The console counts them, so they are the same on every page and survive its reload.

const SURE_MS = 4000;
const $ = (id) => document.getElementById(id);

/** `send(path, name, otherwise)` sends a command; returns `{show(state)}`. */
export function createShift(machine, send, { number, text }) {
  const button = $("shift-new");
  let timer = 0;
  text("shift-logs-name", machine.carrier ? "logs loaded" : "loads lifted");
  // A stationary crane has no mission, which is where volumes and metres come from.
  for (const id of ["shift-m3", "shift-rate", "shift-driven"]) $(id).parentElement.hidden = !machine.carrier;

  button.addEventListener("click", () => {
    if (!timer) {
      timer = setTimeout(calm, SURE_MS);
      button.textContent = "Press again: count from zero";
      return;
    }
    calm();
    send("api/shift/begin", "new shift", "The numbers go on.");
  });

  function calm() {
    clearTimeout(timer);
    timer = 0;
    button.textContent = "New shift …";
  }

  function show(state) {
    const s = state.shift;
    $("shift").hidden = !s;
    if (!s) return;
    button.hidden = !state.may_command;
    text("shift-since", `${span(s.seconds)} so far`);
    text("shift-logs", String(machine.carrier ? s.logs : s.lifts));
    text("shift-m3", `${number(s.m3, 2)} m³`);
    text("shift-rate", s.m3_h === null ? "–" : `${number(s.m3_h, 1)} m³/h`);
    text("shift-stops", String(s.stops));
    text("shift-driven", s.driven_m < 10000 ? `${number(s.driven_m, 0)} m` : `${number(s.driven_m / 1000, 1)} km`);
    text("shift-working", span(s.working_s));
  }

  return { show };
}

function span(seconds) {
  if (seconds < 90) return `${seconds} s`;
  const minutes = Math.floor(seconds / 60);
  return minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")} min`;
}
