// A step in two charts, drawn by uPlot: reference and response; valve and pressures.

import uPlot from "../vendor/uPlot.esm.js";

const HEIGHT = 170, DEGREES = 180 / Math.PI;
const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);

/** `draw(joint, step)` shows a step, or nothing. */
export function createCharts(wayBox, valveBox, unit) {
  const axis = { stroke: () => ink("soft"), grid: { stroke: () => ink("line"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
  const line = (label, colour, dash = [], scale = "y") => ({ label, stroke: () => ink(colour), dash, width: 1.6, scale, points: { show: false } });
  const seconds = { ...axis, size: 26, values: (_, at) => at.map((s) => `${s} s`) };
  const make = (box, series, axes) => {
    const chart = new uPlot({
      width: box.clientWidth || 300, height: HEIGHT, cursor: { show: false }, legend: { live: false },
      scales: { x: { time: false } }, axes, series: [{ label: "time" }, ...series],
    }, [[], ...series.map(() => [])], box);
    new ResizeObserver(() => { if (box.clientWidth) chart.setSize({ width: box.clientWidth, height: HEIGHT }); }).observe(box);
    box.setAttribute("role", "img");
    return chart;
  };
  const way = make(wayBox, [line("reference", "reference", [6, 4]), line("response", "good")], [seconds, { ...axis, size: 46 }]);
  const valve = make(valveBox, [
    line("command", "reference", [6, 4]), line("spool", "good"),
    line("pressure A", "joint-2", [], "bar"), line("pressure B", "joint-3", [2, 3], "bar"),
  ], [seconds, { ...axis, size: 46 }, { ...axis, scale: "bar", side: 1, size: 46, grid: { show: false } }]);

  function draw(joint, step) {
    const metres = joint.unit === "m", scale = metres ? 1000 : DEGREES;
    unit.textContent = metres ? "mm" : "°";
    const t = step?.time_s ?? [], of = (name, by = 1) => (step ? step.series[name].map((v) => (v === null ? null : v * by)) : []);
    way.setData([t, of("reference", scale), of("position", scale)]);
    valve.setData([t, of("command"), of("spool"), of("pressure_a"), of("pressure_b")]);
    const words = step ? `step of the ${joint.name}, ${t.length} samples` : `no step of the ${joint.name} yet`;
    wayBox.setAttribute("aria-label", `Reference and response: ${words}`);
    valveBox.setAttribute("aria-label", `Valve and pressures: ${words}`);
  }
  return { draw };
}
