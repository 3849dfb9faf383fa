// The panels under the view: tracking error, camera, timeline, CAN table, histograms of the tick.  The server sends the data of
// the panel that this page shows, and no other.

import { createBreakIt } from "./break_it.js";
import { createCamera } from "./camera.js";
import { createCanTable } from "./can_table.js";
import { createTicks } from "./ticks.js";
import { createTimeline } from "./timeline.js";

const $ = (id) => document.getElementById(id);
const NOTES = {
  error: "error in mrad, telescope in mm, last 20 s",
  camera: "the newest picture in which logs were measured",
  timeline: "modes, stops and loads, newest first",
  can: "decoded from the bus; counts since this table was opened",
  faults: "only in this simulated run: faults of sensors, valves, buses and processes",
  ticks: "since the controller started; counts on a logarithmic scale",
};

/** `machine.panels` are those that the server can fill; returns `{connected(socket), show(state), choose(name)}`. */
export function createPanels(machine, onPick = null) {
  const names = machine.panels ?? ["error"];
  const timeline = createTimeline($("panel-timeline"), { onPick, beginS: machine.recording?.begin_s });
  const can = createCanTable($("panel-can")), ticks = createTicks($("panel-ticks"));
  const camera = names.includes("camera") ? createCamera($("panel-camera")) : null;
  const breakIt = names.includes("faults") ? createBreakIt($("panel-faults")) : null;
  const tabs = names.map((name) => $(`tab-${name}`));
  let shown = "error", socket = null;

  tabs.forEach((tab, i) => {
    tab.hidden = false;
    tab.addEventListener("click", () => choose(names[i]));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      const next = (i + step + tabs.length) % tabs.length;
      choose(names[next]);
      tabs[next].focus();
    });
  });

  function choose(name) {
    shown = name;
    document.body.dataset.panel = name;
    names.forEach((each, i) => {
      tabs[i].setAttribute("aria-selected", each === name);
      tabs[i].tabIndex = each === name ? 0 : -1;
      $(`panel-${each}`).hidden = each !== name;
    });
    $("panel-note").textContent = machine.recording && name === "can" ? "as recorded; counts since the last jump" : NOTES[name];
    camera?.showing(name === "camera");
    ask();
  }

  function ask() {
    if (socket?.readyState === WebSocket.OPEN) socket.send(`panel ${shown}`);
  }

  return {
    choose,
    connected(open) { socket = open; timeline.recall(); ask(); },
    show(state) {
      timeline.show(state);
      if (state.can) can.show(state.can);
      if (state.ticks) ticks.show(state.ticks);
      if (breakIt) breakIt.show(state);
    },
  };
}
