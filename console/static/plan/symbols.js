// Landings, logs and single points on the map, each with a handle that is dragged.

import { moved } from "./model.js";

const USUAL_LOG_M = 3; // as drawn by `timberhand plan show`
const MOST_HANDLES = 300;

/** A handle for a part, with a real element: `className` gives its looks, dragging moves the part. */
export function dot(latlng, className, part, { pointAt, model, parts, moving }) {
  const icon = L.divIcon({ className: `handle ${className}`, html: "", iconSize: className === "log" ? [13, 13] : [18, 18] });
  const marker = L.marker(latlng, { icon, draggable: moving, keyboard: false, pmIgnore: true, interactive: moving });
  marker.addTo(parts);
  marker.on("click", () => model.choose(part));
  marker.on("dragstart", () => model.choose(part));
  marker.on("dragend", () => {
    const to = pointAt(marker.getLatLng());
    queueMicrotask(() => model.commit(moved(model.mission, part, to)));
  });
  return marker;
}

export function drawLandings({ landings }, places) {
  landings.forEach((landing, i) => {
    const marker = dot(places.at(landing.position), "landing", ["landing", i], places);
    marker.bindTooltip(textNode(landing.name || `landing ${i + 1}`), {
      permanent: landings.length <= 30, direction: "right", offset: [10, 0], className: "name",
    });
  });
}

export function drawLogs({ logs }, places) {
  const few = logs.length <= MOST_HANDLES;
  const canvas = few ? null : L.canvas();
  const color = getComputedStyle(document.documentElement).getPropertyValue("--log");
  logs.forEach((log, i) => {
    const center = places.at(log.position), ends = endsOf(log, center);
    const style = few ? { className: "log-line" } : { renderer: canvas, color, weight: 4 };
    L.polyline(ends, { ...style, interactive: false, pmIgnore: true }).addTo(places.parts);
    if (few) dot(center, "log", ["log", i], places);
  });
}

function endsOf(log, center) {
  const bearing = ((log.bearing_deg ?? 90) * Math.PI) / 180, half = 0.5 * (log.length_m ?? USUAL_LOG_M);
  const [e, n] = [half * Math.sin(bearing), half * Math.cos(bearing)];
  return [L.latLng(center.lat - n, center.lng - e), L.latLng(center.lat + n, center.lng + e)];
}

/** Names come from files: never as HTML. */
function textNode(text) {
  const element = document.createElement("span");
  element.textContent = text;
  return element;
}
