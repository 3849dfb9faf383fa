// Files: missions of the console's folder, files of any format in, files of every format that can be written out.

import { post as send } from "../access.js";
import { allPlaces, emptyMission } from "./model.js";
import { refusalOf } from "./check.js";

const $ = (id) => document.getElementById(id);
const NAMES = { geojson: "GeoJSON", plan: ".plan", gpx: "GPX", kml: "KML" };

/** `opened()` follows a mission that came from a file; returns `{begin(settings), name()}`. */
export function createFiles(model, opened) {
  const note = (text) => { $("file-note").textContent = text; };
  const name = () => `${$("file-name").value.trim() || "mission"}.geojson`;

  async function post(path, body) {
    const answer = await send(path, { body });
    if (!answer.ok) throw await refusalOf(answer);
    return answer.json();
  }

  function guarded(id, work) {
    $(id).addEventListener("click", () => work().catch((error) => note(error.message)));
  }

  async function list() {
    const saved = await (await fetch("api/plan/missions")).json();
    const chosen = $("saved").value;
    $("saved").replaceChildren(...saved.map((file) => new Option(file, file, false, file === chosen)));
    $("open-saved").disabled = !saved.length;
  }

  async function save() {
    const replace = $("save").dataset.again === name() ? "?replace=1" : "";
    try {
      await post(`api/plan/missions/${encodeURIComponent(name())}${replace}`, JSON.stringify(model.mission));
    } catch (error) {
      if (error.code !== "missions.exists") throw error;
      $("save").dataset.again = name();
      $("save").textContent = "Replace";
      note(`${name()} exists already. Press Replace to replace it, or change the name.`);
      return;
    }
    again();
    const told = `Saved as ${name()}.`;
    await list().catch(() => {}); // the mission is saved, whatever became of the list
    note(told);
  }

  function again() {
    $("save").textContent = "Save";
    delete $("save").dataset.again;
  }

  /** A mission from a file; of an imported one that holds only logs, these are added to the plan. */
  function take({ mission, format, notes }, from, imports = false) {
    const onlyLogs = mission.logs.length > 0 && allPlaces(mission).length === mission.logs.length;
    const adds = imports && onlyLogs && allPlaces(model.mission).length > 0;
    const logs = [...model.mission.logs, ...mission.logs];
    model.commit(adds ? { ...model.mission, logs } : mission);
    note([`${from}: ${format}${adds ? `, ${mission.logs.length} logs added` : ""}.`, ...notes.map((n) => `Note: ${n}.`)].join(" "));
    opened();
  }

  guarded("save", save);
  guarded("open-saved", async () => {
    const file = $("saved").value, answer = await fetch(`api/plan/missions/${encodeURIComponent(file)}`);
    if (!answer.ok) throw await refusalOf(answer);
    take(await answer.json(), file);
    $("file-name").value = file.replace(/\.geojson$/, "");
    $("file-name").dispatchEvent(new Event("input"));
  });
  guarded("export", async () => {
    const kind = $("format").value, told = await post(`api/plan/export/${kind}`, JSON.stringify(model.mission));
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([told.text]));
    link.download = name().replace(/geojson$/, kind);
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    note(told.left_out.length ? `${link.download} does not hold: ${told.left_out.join(", ")}.` : `${link.download} holds everything.`);
  });
  guarded("clear", async () => {
    model.commit(emptyMission());
    note("A new plan. Undo brings the last one back.");
    opened();
  });
  $("import").addEventListener("change", async () => {
    const file = $("import").files[0];
    if (!file) return;
    try {
      take(await post(`api/plan/import?name=${encodeURIComponent(file.name)}`, file), file.name, true);
    } catch (error) { note(error.message); }
    $("import").value = "";
  });
  $("file-name").addEventListener("input", again);

  function begin(settings) {
    $("format").replaceChildren(...settings.formats.map((kind) => new Option(NAMES[kind] ?? kind, kind)));
    const folder = settings.folder !== null;
    $("saved-line").hidden = $("save-line").hidden = !folder;
    $("folder").textContent = folder ? `in ${settings.folder}` : "";
    if (folder) list().catch((error) => note(error.message));
  }
  return { begin, name, list };
}
