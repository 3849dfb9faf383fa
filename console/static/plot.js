// Time plot on a canvas: one line per joint over the last seconds.

const SPAN_S = 20;
/** Dash pattern of each joint; the colours come from the style sheet. */
export const LINES = [[], [7, 3], [2, 3], [9, 3, 2, 3], [4, 4]];

/** Keeps samples of `{t, values}` (t in seconds, a value may be null) and draws them; returns `{add, load}`. */
export function createPlot(canvas) {
  const samples = [];
  let scheduled = false;
  const style = getComputedStyle(document.documentElement);
  const ink = (name) => style.getPropertyValue(`--${name}`);

  function add(t, values) {
    if (t === samples.at(-1)?.t) return; // the same report again
    if (samples.length && t < samples.at(-1).t) samples.length = 0;
    samples.push({ t, values });
    while (samples[0].t < t - SPAN_S) samples.shift();
    draw();
  }

  function draw() {
    if (scheduled) return;
    scheduled = true;
    requestAnimationFrame(() => { scheduled = false; if (samples.length) paint(samples.at(-1).t); });
  }

  function paint(now) {
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const g = canvas.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, width, height);

    const left = 44, top = 6, bottom = height - 6;
    let reach = 5;
    for (const s of samples) for (const v of s.values) if (v !== null) reach = Math.max(reach, Math.abs(v));
    const step = niceStep(reach);
    reach = Math.ceil(reach / step) * step;
    const x = (t) => left + (1 - (now - t) / SPAN_S) * (width - left - 4);
    const y = (v) => (top + bottom) / 2 - (v / reach) * (bottom - top) / 2;

    g.font = "11px system-ui, sans-serif";
    g.textAlign = "right";
    g.textBaseline = "middle";
    g.lineWidth = 1;
    for (let v = -reach; v <= reach + 1e-9; v += step) {
      g.strokeStyle = ink(Math.abs(v) < 1e-9 ? "soft" : "line");
      g.beginPath(); g.moveTo(left, y(v)); g.lineTo(width - 4, y(v)); g.stroke();
      g.fillStyle = ink("soft");
      g.fillText(String(Math.round(v)), left - 8, y(v));
    }
    LINES.forEach((dash, j) => {
      g.strokeStyle = ink(`joint-${j}`);
      g.lineWidth = 1.6;
      g.setLineDash(dash);
      g.beginPath();
      let down = false;
      for (const s of samples) {
        const v = s.values[j];
        if (v === null) { down = false; continue; }
        if (down) g.lineTo(x(s.t), y(v)); else g.moveTo(x(s.t), y(v));
        down = true;
      }
      g.stroke();
    });
    g.setLineDash([]);
  }

  /** Replaces the samples by `[t, values]` of a recording. */
  function load(history) {
    samples.length = 0;
    for (const [t, values] of history) samples.push({ t, values });
    draw();
  }

  return { add, load };
}

function niceStep(reach) {
  const rough = reach / 2;
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough);
}
