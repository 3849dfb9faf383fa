// The map of the plan: Leaflet in metres about the site's origin; Leaflet-Geoman edits route and fences.

import { addGrid } from "./grid.js";
import { MARKS } from "./check.js";
import { drawLandings, drawLogs, dot } from "./symbols.js";
import { added, allPlaces, placeOf, withItem } from "./model.js";

const MOST_HANDLES = 300; // of a route or all fences: more are edited in the table
const EDIT = {
  allowSelfIntersection: true, snappable: false, hideMiddleMarkers: false, removeLayerBelowMinVertexCount: false,
};

/** `model`: see model.js; `frame()` is the present frame; returns `{draw, marks, use, fit, show, close, grid}`. */
export function createMap(container, model, frame) {
  const map = L.map(container, {
    crs: L.CRS.Simple, attributionControl: false, zoomAnimation: false, zoomSnap: 0.25, minZoom: -8, maxZoom: 7,
    zoomControl: false, doubleClickZoom: false, boxZoom: false,
  });
  L.control.zoom({ position: "bottomright" }).addTo(map);
  map.setView([0, 0], 2);
  const grid = addGrid(map);
  const wood = L.layerGroup().addTo(map), parts = L.layerGroup().addTo(map), marked = L.layerGroup().addTo(map), choice = L.layerGroup().addTo(map);
  let tool = "move", findings = [], drawn = [];

  const at = (point) => { const [e, n] = frame().local(point); return L.latLng(n, e); };
  const pointAt = (latlng) => frame().point(latlng.lng, latlng.lat);

  /** The places of edited positions: those that did not move stay exactly as they were. */
  function placesOf(latlngs, before) {
    const known = new Map(before.map((point) => [key(at(point)), point]));
    return latlngs.map((p) => known.get(key(p)) ?? pointAt(p));
  }

  // ---- drawing the mission ------------------------------------------------------------------------------

  function draw() {
    if (map.pm.Draw.Polygon.enabled()) return; // a fence is being drawn: nothing else can have changed
    parts.clearLayers();
    const { mission } = model;
    const corners = mission.fences.reduce((n, f) => n + f.corners.length, 0);
    mission.fences.forEach((fence, i) => {
      const shape = L.polygon(fence.corners.map(at), { className: fence.keep_out ? "keep-out" : "fence" }).addTo(parts);
      shape.on("click", (event) => { if (tool === "move") { L.DomEvent.stop(event); model.choose(["fence", i]); } });
      if (corners <= MOST_HANDLES) edit(shape, (latlngs) => withItem(model.mission, ["fence", i], {
        ...model.mission.fences[i], corners: placesOf(latlngs[0], model.mission.fences[i].corners),
      }), (j) => ["corner", i, j]);
    });
    drawRoute(mission);
    const places = { at, pointAt, model, parts, moving: tool === "move" };
    drawLandings(mission, places);
    const wanted = [mission.logs, places.moving, frame()];
    if (wanted.some((part, i) => part !== drawn[i])) { // a harvester's file has thousands
      wood.clearLayers();
      drawLogs(mission, { ...places, parts: wood });
      drawn = wanted;
    }
    drawChoice();
    drawMarks();
  }

  function drawRoute({ waypoints, options }) {
    const latlngs = waypoints.map(at);
    if ((options.laps ?? 1) > 1 && latlngs.length > 2) {
      L.polyline([latlngs.at(-1), latlngs[0]], { className: "route closing", interactive: false }).addTo(parts);
    }
    const line = L.polyline(latlngs, { className: "route", interactive: false }).addTo(parts);
    const route = (points) => ({ ...model.mission, waypoints: placesOf(points, model.mission.waypoints) });
    if (latlngs.length > 1 && latlngs.length <= MOST_HANDLES) edit(line, route, (i) => ["waypoint", i]);
    if (latlngs.length === 1) dot(latlngs[0], "waypoint", ["waypoint", 0], { at, pointAt, model, parts, moving: true });
    if (latlngs.length <= 100) latlngs.forEach((p, i) => label(p, String(i + 1), "number"));
  }

  function label(latlng, text, className) {
    const icon = L.divIcon({ className: `label ${className}`, html: "", iconSize: [30, 18], iconAnchor: [-6, 24] });
    const marker = L.marker(latlng, { icon, interactive: false, keyboard: false, pmIgnore: true }).addTo(parts);
    marker.getElement().textContent = text;
  }

  /** Let Geoman edit a layer; `changed(latlngs)` is the mission after an edit, `part(index)` the part of a vertex. */
  function edit(layer, changed, part) {
    if (tool !== "move") return;
    layer.pm.enable(EDIT);
    // Geoman goes on with the layer after its events, so it is replaced later.
    const commit = () => queueMicrotask(() => model.commit(changed(layer.getLatLngs())));
    layer.on("pm:markerdragend pm:vertexremoved", commit);
    layer.on("pm:vertexadded", (event) => { if (event.shape) commit(); });
    layer.on("pm:vertexclick pm:markerdragstart", ({ indexPath }) => model.choose(part(indexPath.at(-1))));
  }

  // ---- choice and marks ---------------------------------------------------------------------------------

  function drawChoice() {
    choice.clearLayers();
    const point = model.chosen && placeOf(model.mission, model.chosen);
    if (point) L.circleMarker(at(point), { radius: 15, className: "chosen", interactive: false }).addTo(choice);
  }

  function drawMarks() {
    marked.clearLayers();
    for (const { part, kind, sentence } of findings) {
      const point = part && placeOf(model.mission, part);
      if (!point) continue;
      const icon = L.divIcon({ className: `mark ${kind}`, html: "", iconSize: [22, 22], iconAnchor: [28, 28] });
      const marker = L.marker(at(point), { icon, interactive: false, keyboard: false, pmIgnore: true }).addTo(marked);
      marker.getElement().textContent = MARKS[kind];
      marker.getElement().title = sentence;
    }
  }

  // ---- tools --------------------------------------------------------------------------------------------

  map.on("click", ({ latlng }) => {
    if (tool === "waypoint" || tool === "landing" || tool === "log") {
      model.commit(added(model.mission, tool, pointAt(latlng)));
      const list = { waypoint: "waypoints", landing: "landings", log: "logs" }[tool];
      model.choose([tool, model.mission[list].length - 1]);
    } else if (tool === "move") model.choose(null);
  });
  map.on("pm:create", ({ layer }) => {
    layer.remove();
    const corners = layer.getLatLngs()[0].map(pointAt), count = model.mission.fences.length;
    queueMicrotask(() => {
      model.commit({
        ...model.mission,
        fences: [...model.mission.fences, { corners: turned(corners), keep_out: tool === "keep-out", name: "" }],
      });
      model.choose(["fence", count]);
      if (tool === "fence" || tool === "keep-out") drawFence();
    });
  });

  /** Corners counter-clockwise, as files have them. */
  function turned(corners) {
    const p = corners.map(at);
    const area = p.reduce((sum, a, i) => { const b = p[(i + 1) % p.length]; return sum + a.lng * b.lat - b.lng * a.lat; }, 0);
    return area >= 0 ? corners : corners.reverse();
  }

  function drawFence() {
    map.pm.enableDraw("Polygon", {
      snappable: false, allowSelfIntersection: true, tooltips: false, finishOn: "dblclick", continueDrawing: false,
      templineStyle: { className: tool }, hintlineStyle: { className: `${tool} hint` }, pathOptions: { className: tool },
    });
  }

  function use(name) {
    map.pm.disableDraw();
    tool = name;
    container.dataset.tool = name;
    if (name === "fence" || name === "keep-out") drawFence();
    draw();
  }

  function fit() {
    const places = allPlaces(model.mission).map(at);
    if (!places.length) places.push(L.latLng(-40, -40), L.latLng(40, 40));
    const over = getComputedStyle(document.querySelector(".tools")).position === "absolute"; // the buttons lie on the map
    map.fitBounds(L.latLngBounds(places).pad(0.02), { paddingTopLeft: [50, over ? 120 : 40], paddingBottomRight: [50, 70], maxZoom: 4 });
  }

  function show(part) {
    model.choose(part);
    const point = placeOf(model.mission, part);
    if (point && !map.getBounds().pad(-0.1).contains(at(point))) map.panTo(at(point), { animate: false });
  }

  const key = (latlng) => `${latlng.lat},${latlng.lng}`;
  new ResizeObserver(() => map.invalidateSize({ animate: false })).observe(container);
  return {
    draw, fit, show, use, drawChoice, grid,
    marks(told) { findings = told; drawMarks(); },
    /** Ends a fence that is being drawn. */
    close() { if (map.pm.Draw.Polygon.enabled()) map.pm.Draw.Polygon._finishShape(); },
    screen: (point) => map.latLngToContainerPoint(at(point)),
  };
}
