// The mission that is planned: plain data as in autonomy/missions/model.py, its history, and the chosen part.
// A part is named as by the check: ["waypoint", i], ["fence", i], ["corner", fence, i], ["landing", i], ["log", i].

export const LISTS = { waypoint: "waypoints", fence: "fences", landing: "landings", log: "logs" };
const KEPT = 200, DRAFT = "timberhand.plan";

export function emptyMission() {
  return { name: "", waypoints: [], fences: [], landings: [], logs: [], options: {}, schema: 1 };
}

/** `changed(what)` follows every change: "mission" or "choice". */
export function createModel(changed) {
  let past = [], future = [];
  const model = {
    mission: recalled() ?? emptyMission(),
    chosen: null,
    commit(next) {
      past = [...past.slice(-KEPT), model.mission];
      future = [];
      show(next);
    },
    undo() { if (past.length) { future.push(model.mission); show(past.pop()); } },
    redo() { if (future.length) { past.push(model.mission); show(future.pop()); } },
    get mayUndo() { return past.length > 0; },
    get mayRedo() { return future.length > 0; },
    choose(part) {
      if (String(part) === String(model.chosen)) return;
      model.chosen = part;
      changed("choice");
    },
  };
  function show(next) {
    model.mission = next;
    if (model.chosen && !exists(next, model.chosen)) model.chosen = null;
    try { localStorage.setItem(DRAFT, JSON.stringify(next)); } catch { /* a large plan is only kept in its file */ }
    changed("mission");
  }
  return model;
}

function recalled() {
  try {
    const kept = JSON.parse(localStorage.getItem(DRAFT));
    return kept?.schema === 1 && Object.values(LISTS).every((list) => Array.isArray(kept[list])) ? kept : null;
  } catch { return null; }
}

export function exists(mission, [kind, i, j]) {
  return kind === "corner" ? Boolean(mission.fences[i]?.corners[j]) : Boolean(mission[LISTS[kind]]?.[i]);
}

/** The place of a part; the first corner of a fence. */
export function placeOf(mission, [kind, i, j]) {
  if (kind === "waypoint") return mission.waypoints[i];
  if (kind === "fence") return mission.fences[i]?.corners[0];
  if (kind === "corner") return mission.fences[i]?.corners[j];
  return mission[LISTS[kind]]?.[i]?.position;
}

const replaced = (list, i, item) => list.map((old, k) => (k === i ? item : old));

/** The mission with a part at another place. */
export function moved(mission, [kind, i, j], point) {
  if (kind === "waypoint") return { ...mission, waypoints: replaced(mission.waypoints, i, point) };
  if (kind === "corner") {
    const fence = mission.fences[i];
    return withItem(mission, ["fence", i], { ...fence, corners: replaced(fence.corners, j, point) });
  }
  const list = LISTS[kind];
  return { ...mission, [list]: replaced(mission[list], i, { ...mission[list][i], position: point }) };
}

/** The mission with another fence, landing or log in a part's place. */
export function withItem(mission, [kind, i], item) {
  return { ...mission, [LISTS[kind]]: replaced(mission[LISTS[kind]], i, item) };
}

/** The mission without a part; a fence that would keep fewer than three corners goes as a whole. */
export function without(mission, [kind, i, j]) {
  if (kind === "corner" && mission.fences[i].corners.length > 3) {
    const fence = mission.fences[i];
    return withItem(mission, ["fence", i], { ...fence, corners: fence.corners.filter((_, k) => k !== j) });
  }
  const list = LISTS[kind === "corner" ? "fence" : kind];
  return { ...mission, [list]: mission[list].filter((_, k) => k !== i) };
}

/** The mission with one more waypoint, landing or log at the end of its list. */
export function added(mission, kind, point) {
  const item = {
    waypoint: () => point,
    landing: () => ({ position: point, name: "", bearing_deg: null, assortments: [] }),
    log: () => ({
      position: point, key: "", bearing_deg: null, length_m: null, diameter_m: null, species: "", assortment: "",
      product_key: null, sigma_m: null,
    }),
  }[kind]();
  return { ...mission, [LISTS[kind]]: [...mission[LISTS[kind]], item] };
}

/** The mission with latitude and longitude exchanged, of all places or of the given parts. */
export function exchanged(mission, parts) {
  const turn = (p) => ({ ...p, latitude_deg: p.longitude_deg, longitude_deg: p.latitude_deg });
  if (parts) return parts.reduce((m, part) => moved(m, part, turn(placeOf(m, part))), mission);
  const positioned = (x) => ({ ...x, position: turn(x.position) });
  return {
    ...mission,
    waypoints: mission.waypoints.map(turn),
    fences: mission.fences.map((f) => ({ ...f, corners: f.corners.map(turn).reverse() })),
    landings: mission.landings.map(positioned),
    logs: mission.logs.map(positioned),
  };
}

export function allPlaces(mission) {
  const positions = [...mission.landings, ...mission.logs].map((x) => x.position);
  return [...mission.waypoints, ...mission.fences.flatMap((f) => f.corners), ...positions];
}
