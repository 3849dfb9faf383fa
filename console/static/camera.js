// The camera's newest measured picture, with the logs that were found in it and the chosen grasp.  It is asked for only
// while this panel is shown.

const PERIOD_MS = 500, PATIENCE_MS = 2000;
const SVG = "http://www.w3.org/2000/svg";

const add = (parent, name, className = "", words = "") => {
  const element = parent.appendChild(document.createElement(name));
  if (className) element.className = className;
  element.textContent = words;
  return element;
};
const put = (element, words) => { if (element.textContent !== words) element.textContent = words; };

/** Fills `container`; returns `{showing(so)}`: whether the panel is shown. */
export function createCamera(container) {
  const figure = add(container, "figure", "camera-picture"), marks = document.createElementNS(SVG, "svg");
  let picture = add(figure, "img");
  figure.append(marks);
  const beside = add(container, "div", "camera-words"), title = add(beside, "h2"), words = add(beside, "p", "note");
  const grasp = add(beside, "p", "camera-grasp"), list = add(beside, "ul", "camera-logs");
  figure.hidden = true;
  marks.setAttribute("preserveAspectRatio", "xMinYMin meet");
  marks.setAttribute("aria-hidden", "true"); // the list says the same
  put(title, "Camera");
  put(words, "Waiting for the log detector.");
  let timer = 0, loaded = 0, busy = false;

  /** The new picture takes the place of the old one when it is complete, so that nothing flickers. */
  async function load(state) {
    const next = new Image(state.width_px, state.height_px), found = state.logs.filter((log) => log.seen).length;
    next.alt = `Picture of the camera ${state.camera}: ${found} logs found`;
    next.src = `api/camera/${state.picture}`;
    await next.decode();
    figure.style.aspectRatio = `${state.width_px} / ${state.height_px}`;
    picture.replaceWith(next);
    picture = next;
    loaded = state.picture;
  }

  async function ask() {
    if (document.hidden || busy) return;
    busy = true;
    try {
      const answer = await fetch("api/camera", { signal: AbortSignal.timeout(PATIENCE_MS) });
      if (answer.ok) await show(await answer.json());
    } catch {
      put(words, "The console does not answer: the picture is outdated.");
      figure.classList.add("old");
    } finally { busy = false; }
  }

  async function show(state) {
    put(words, state.words);
    figure.hidden = beside.dataset.empty = !state.picture;
    if (!state.picture) {
      put(title, "Camera");
      put(grasp, "");
      list.replaceChildren();
      return;
    }
    if (state.picture !== loaded) await load(state);
    figure.classList.toggle("old", Boolean(state.words));
    put(title, `Camera ${state.camera} · ${age(state.age_s)} ago`);
    put(grasp, graspWords(state));
    const chosen = new Set(state.grasp?.logs ?? []);
    draw(state, chosen);
    tell(state, chosen);
  }

  function draw(state, chosen) {
    marks.setAttribute("viewBox", `0 0 ${state.width_px} ${state.height_px}`);
    const parts = [], labels = [];
    for (const log of state.logs.filter((each) => each.seen && each.ends_px)) {
      const [[x1, y1], [x2, y2]] = log.ends_px, kind = chosen.has(log.id) ? "axis chosen" : "axis";
      parts.push(shape("line", { x1, y1, x2, y2 }, kind));
      labels.push(shape("text", { x: x1 + 0.2 * (x2 - x1), y: y1 + 0.2 * (y2 - y1) + 8 }, kind, log.id));
    }
    if (state.grasp?.tips_px) {
      const [[x1, y1], [x2, y2]] = state.grasp.tips_px;
      for (const kind of ["halo", "grasp"]) {
        parts.push(shape("line", { x1, y1, x2, y2 }, kind));
        for (const [cx, cy] of state.grasp.tips_px) parts.push(shape("circle", { cx, cy, r: 6 }, kind));
      }
    }
    marks.replaceChildren(...parts, ...labels);
  }

  function tell(state, chosen) {
    const items = state.logs.map((log) => {
      const seen = log.seen ? "" : ", remembered", mark = chosen.has(log.id) ? ", chosen" : "";
      return `log ${log.id}: ${log.length_m.toFixed(2)} m × ${(100 * log.diameter_m).toFixed(0)} cm${mark}${seen}`;
    });
    if (list.dataset.shown === items.join()) return;
    list.dataset.shown = items.join();
    list.replaceChildren(...items.map((each) => Object.assign(document.createElement("li"), { textContent: each })));
  }

  return {
    showing(so) {
      clearInterval(timer);
      if (!so) return;
      ask();
      timer = setInterval(ask, PERIOD_MS);
    },
  };
}

function shape(name, values, className, words = "") {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(values)) element.setAttribute(key, value);
  element.setAttribute("class", className);
  element.textContent = words;
  return element;
}

function graspWords(state) {
  const g = state.grasp;
  if (!g) return "No grasp is chosen.";
  const where = state.moved ? " The machine has moved since this picture, so it is not drawn."
    : g.tips_px ? "" : " It is outside this picture.";
  return `Chosen grasp: ${g.reason || `log ${g.logs.join(", ")}`}.${where}`;
}

function age(seconds) {
  return seconds < 100 ? `${seconds.toFixed(0)} s` : `${(seconds / 60).toFixed(0)} min`;
}
