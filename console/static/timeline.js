// The timeline: a strip of the modes with marks, and a list of what happened, each stop with its sentence and remedy.

const WORDS = { STOP: "STOPPED" };
/** Made once: one for each entry was nearly half of the page's script over a shift (measured). */
const CLOCK = new Intl.DateTimeFormat([], { hour: "numeric", minute: "numeric", second: "numeric", hourCycle: "h23" });
const MARKS = { stop: "■", load: "▲", grip: "▲", mission: "●", mode: "○" };

const add = (parent, name, className = "", words = "") => {
  const element = parent.appendChild(document.createElement(name));
  if (className) element.className = className;
  element.textContent = words;
  return element;
};

/** `onPick(entry)`: an entry is chosen (replay); `beginS`: times are shown since then, else as the clock's. */
export function createTimeline(container, { onPick = null, beginS = null } = {}) {
  const strip = add(container, "div", "strip"), list = add(container, "ol", "events");
  strip.setAttribute("aria-hidden", "true"); // the list says the same
  const empty = add(container, "p", "note", "Nothing has happened yet.");
  let entries = [], known = -1, nowS = null, asking = false;

  async function recall() {
    if (asking) return;
    asking = true;
    try {
      const answer = await fetch("api/timeline");
      if (answer.ok) {
        entries = await answer.json();
        known = entries.at(-1)?.n ?? 0;
        draw();
      }
    } catch { /* the next state asks again */ } finally { asking = false; }
  }

  function show(state) {
    nowS = state.time_s ?? nowS;
    if (state.entries !== known) recall();
  }

  function draw() {
    empty.hidden = entries.length > 0;
    list.replaceChildren(...entries.map(item).reverse());
    drawStrip(strip, entries, entries[0]?.at_s ?? 0, Math.max(nowS ?? 0, entries.at(-1)?.at_s ?? 0));
  }

  function item(entry) {
    const li = document.createElement("li");
    li.className = `of-${entry.kind}`;
    add(li, "time", "", when(entry.at_s));
    const what = add(li, "div"), title = add(what, "b", "", `${MARKS[entry.kind] ?? ""} ${WORDS[entry.title] ?? entry.title}`);
    if (entry.kind === "stop") title.append(` · ${WORDS[entry.mode] ?? entry.mode}`);
    if (entry.text) add(what, "p", "", entry.text);
    if (entry.advice) add(what, "p", "advice", `What to do: ${entry.advice}`);
    if (onPick) {
      const words = entry.kind === "stop" ? "Show 10 s before" : "Show";
      const button = add(li, "button", "", words);
      button.type = "button";
      button.setAttribute("aria-label", `${words}: ${entry.title} ${when(entry.at_s)}`);
      button.addEventListener("click", () => onPick(entry));
    }
    return li;
  }

  function when(atS) {
    if (beginS !== null && beginS !== undefined) return `${(atS - beginS).toFixed(1)} s`;
    if (nowS === null) return "";
    return CLOCK.format(Date.now() - (nowS - atS) * 1000);
  }

  return { recall, show, entries: () => entries };
}

/** Bands of the modes and marks of stops and loads, from `begin` to `end` [s]. */
export function drawStrip(strip, entries, begin, end) {
  const span = Math.max(end - begin, 1e-3), share = (s) => `${Math.min(100, Math.max(0, (100 * (s - begin)) / span))}%`;
  const parts = [], modes = entries.filter((e) => e.mode);
  modes.forEach((entry, i) => {
    const band = document.createElement("i");
    band.className = entry.mode;
    band.style.left = share(entry.at_s);
    band.style.right = `calc(100% - ${share(modes[i + 1]?.at_s ?? end)})`;
    parts.push(band);
  });
  for (const entry of entries.filter((e) => e.kind === "stop" || e.kind === "load" || e.kind === "grip")) {
    const mark = document.createElement("b");
    mark.className = entry.kind;
    mark.style.left = share(entry.at_s);
    parts.push(mark);
  }
  strip.replaceChildren(...parts);
}
