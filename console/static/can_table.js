// The decoded CAN table: a row per message, its cells updated in place.

const COLUMNS = [["id", "id"], ["message", "message"], ["rate", "per s"], ["age", "age"], ["refused", "refused"], ["lost", "lost"],
  ["values", "newest values"]];

const add = (parent, name, className = "", words = "") => {
  const element = parent.appendChild(document.createElement(name));
  if (className) element.className = className;
  element.textContent = words;
  return element;
};
const put = (element, words) => { if (element.textContent !== words) element.textContent = words; };

/** Fills `container`; `show(buses)` takes the server's tables. */
export function createCanTable(container) {
  const label = add(container, "label", "can-find", "Find message or signal");
  const find = label.appendChild(document.createElement("input"));
  find.type = "search";
  find.autocomplete = "off";
  find.addEventListener("input", () => { for (const bus of buses.values()) bus.filter(find.value); });
  // Space and Escape mean STOP on the whole page; every other key belongs to the field.
  const tables = add(container, "div", "can-tables");
  const buses = new Map();
  put(add(tables, "p", "note"), "Waiting for the first frames.");

  function show(found) {
    if (!buses.size) tables.replaceChildren();
    for (const bus of found) {
      if (!buses.has(bus.bus)) buses.set(bus.bus, createBus(tables, bus.bus));
      buses.get(bus.bus).show(bus, find.value);
    }
  }
  return { show };
}

function createBus(parent, name) {
  const section = add(parent, "section", "can-bus");
  const head = add(section, "h2", "", name);
  const facts = add(head, "small"), meter = add(section, "div", "meter");
  const bar = add(meter, "i"), note = add(section, "p", "note");
  const table = add(section, "table", "can"), row = add(add(table, "thead"), "tr");
  for (const [key, words] of COLUMNS) add(row, "th", key, words).scope = "col";
  const body = add(table, "tbody"), rows = new Map();
  let wanted = "";

  function filter(words) {
    wanted = words.toLowerCase();
    for (const r of rows.values()) r.tr.hidden = Boolean(wanted) && !r.words.includes(wanted);
  }

  function show(bus, words) {
    table.hidden = meter.hidden = Boolean(bus.refusal);
    put(note, bus.refusal ? `Not shown: ${bus.refusal}` : bus.dropped ? `${bus.dropped} frames came too fast for this table.` : "");
    if (bus.refusal) return put(facts, "");
    const load = bus.load_pct === null ? "load unknown" : `load at least ${bus.load_pct.toFixed(0)} %`;
    const other = bus.other ? `, ${bus.other} frames of further identifiers` : "";
    put(facts, `${load}, ${bus.frames_per_s} frames/s${bus.state ? `, ${bus.state.toLowerCase()}` : ""}${other}`);
    bar.style.width = `${Math.min(100, bus.load_pct ?? 0)}%`;
    let fresh = false;
    for (const r of bus.rows) {
      if (!rows.has(r.id)) { rows.set(r.id, createRow(r)); fresh = true; }
      rows.get(r.id).show(r);
    }
    if (fresh) {
      body.replaceChildren(...bus.rows.map((r) => rows.get(r.id).tr));
      filter(words);
    }
    for (const [id, r] of rows) if (!bus.rows.some((each) => each.id === id)) { r.tr.remove(); rows.delete(id); }
  }
  return { show, filter };
}

function createRow(r) {
  const tr = document.createElement("tr");
  const cell = Object.fromEntries(COLUMNS.map(([key]) => [key, add(tr, "td", key)]));
  cell.id.textContent = r.id;
  add(cell.message, "b", "", r.name || "unknown");
  if (r.sender) add(cell.message, "small", "", ` ${r.sender}`);
  const values = new Map();
  const words = `${r.id} ${r.name} ${r.sender} ${r.values.map(([name]) => name).join(" ")}`.toLowerCase();

  function show(now) {
    put(cell.rate, String(now.rate_hz));
    put(cell.age, age(now.age_ms));
    cell.age.classList.toggle("warn", now.late);
    cell.age.title = now.late ? "longer than the time-out of the message" : "";
    put(cell.refused, now.refused || now.e2e || now.name ? String(now.refused) : "–");
    cell.refused.classList.toggle("warn", now.refused > 0);
    cell.refused.title = now.why || (now.e2e ? "checksum and counter are checked" : "only length and range are checked");
    put(cell.lost, now.e2e ? String(now.lost) : "–");
    for (const name of values.keys()) if (!now.values.some((v) => v[0] === name)) { values.get(name).item.remove(); values.delete(name); }
    for (const [name, value, unit] of now.values) {
      if (!values.has(name)) {
        const item = add(cell.values, "span");
        if (name) add(item, "small", "", name);
        values.set(name, { item, value: add(item, "span") });
      }
      put(values.get(name).value, unit ? `${value} ${unit}` : value);
    }
  }
  return { tr, words, show };
}

function age(ms) {
  return ms < 10000 ? `${ms} ms` : `${(ms / 1000).toFixed(0)} s`;
}
