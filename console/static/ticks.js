// Histograms of the controller's tick, drawn by uPlot.

import uPlot from "./vendor/uPlot.esm.js";

const HEIGHT = 104;
const DECADES = [1, 10, 100, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8];
const us = (v) => (v >= 1000 ? `${+(v / 1000).toPrecision(3)} ms` : `${+v.toPrecision(3)} µs`);

/** Fills `container`; `show(ticks)` takes the server's histograms. */
export function createTicks(container) {
  const charts = new Map();
  container.textContent = "Waiting for the controller's timing.";

  function show(ticks) {
    if (!charts.size) container.replaceChildren();
    for (const of of ticks.of) {
      if (!charts.has(of.name)) charts.set(of.name, createChart(container, of, ticks.edges_us));
      charts.get(of.name)(of);
    }
  }
  return { show };
}

function createChart(container, of, edges) {
  const figure = container.appendChild(document.createElement("figure"));
  const caption = figure.appendChild(document.createElement("figcaption"));
  const title = caption.appendChild(document.createElement("b")), facts = caption.appendChild(document.createElement("small"));
  title.textContent = of.words;
  const box = figure.appendChild(document.createElement("div"));
  const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
  const xs = of.counts.map((_, i) => i);
  const label = (i) => (i < edges.length ? us(edges[i]) : "more");
  const axis = { stroke: () => ink("soft"), grid: { stroke: () => ink("line"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
  const plot = new uPlot({
    width: box.clientWidth || 300, height: HEIGHT, legend: { show: false }, cursor: { show: false },
    scales: { x: { time: false, range: () => [-0.6, of.counts.length - 0.4] }, y: { distr: 3, range: (_, min, max) => [0.5, Math.max(10, max * 2)] } },
    axes: [
      { ...axis, splits: () => xs.filter((i) => i % 3 === 2), values: (_, at) => at.map(label), size: 24 },
      { ...axis, size: 44, splits: (_, i, min, max) => DECADES.filter((v) => v >= min && v <= max), values: (_, at) => at.map((v) => (v === null ? "" : v >= 1000 ? `${v / 1000}k` : String(v))) },
    ],
    series: [{}, { fill: () => ink("good"), width: 0, points: { show: false }, paths: uPlot.paths.bars({ size: [0.8, 40] }) }],
  }, [xs, of.counts], box);
  new ResizeObserver(() => { if (box.clientWidth) plot.setSize({ width: box.clientWidth, height: HEIGHT }); }).observe(box);

  return (now) => {
    plot.setData([xs, now.counts.map((n) => n || null)]);
    const words = now.count ? `median ${us(now.p50_us)}, 99.9 % ${us(now.p999_us)}, longest ${us(now.max_us)}` : "not measured yet";
    facts.textContent = ` ${words}`;
    box.setAttribute("role", "img");
    box.setAttribute("aria-label", `${now.words}: ${words}`);
  };
}
