// Map of the site: route, fences, landings, track, logs, and the machine to scale.  Metres, north up.

const STEPS_M = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000];
const MACHINE_VIEW_M = 14;
const NAMES = ["text", "soft", "line", "panel", "good", "reference", "stop-bright", "route", "trail", "log", "target", "halo"];

/** Draws into `canvas`; returns `{mission, vehicle, crane, trail, view}`.  Calls `onMoved` when the user moves the map. */
export function createMap(canvas, machine, onMoved) {
  const carrier = machine.carrier;
  let mission = null, current = true, vehicle = null, points = null, trail = [];
  let view = "site", center = [0, 0], scale = 10, scheduled = false, ink = inks();

  matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => { ink = inks(); draw(); });
  new ResizeObserver(draw).observe(canvas);

  function inks() {
    const style = getComputedStyle(document.documentElement);
    return Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  }

  function draw() {
    if (scheduled) return;
    scheduled = true;
    requestAnimationFrame(() => { scheduled = false; paint(); });
  }

  // ---- map section ----------------------------------------------------------------------------------------

  function fit(width, height) {
    const place = vehicle?.place;
    if (view === "machine" && place) {
      center = [place.x_m, place.y_m];
      scale = Math.min(width, height) / (2 * MACHINE_VIEW_M);
      return;
    }
    if (view !== "site" && view !== "machine") return;
    const all = [...(mission?.route ?? []), ...(mission?.fences ?? []).flatMap((f) => f.corners),
      ...(mission?.landings ?? []).map((l) => l.at), ...(place ? [[place.x_m, place.y_m]] : []), ...(mission ? [] : trail)];
    if (!all.length) return;
    const xs = all.map((p) => p[0]), ys = all.map((p) => p[1]);
    const [w, e, s, n] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    center = [(w + e) / 2, (s + n) / 2];
    scale = Math.min((width - 70) / Math.max(e - w, 20), (height - 96) / Math.max(n - s, 20));
  }

  // ---- drawing ---------------------------------------------------------------------------------------------

  function paint() {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const g = canvas.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    fit(width, height);
    const at = ([x, y]) => [width / 2 + (x - center[0]) * scale, height / 2 - (y - center[1]) * scale];
    const path = (list, close) => {
      g.beginPath();
      list.forEach((p, i) => (i ? g.lineTo(...at(p)) : g.moveTo(...at(p))));
      if (close) g.closePath();
    };
    g.lineJoin = g.lineCap = "round";
    g.font = "12px system-ui, sans-serif";
    g.globalAlpha = current ? 1 : 0.4; // outdated data are drawn pale; the machine has its own state
    if (mission) paintSite(g, at, path);
    stroke(g, ink.trail, 2.5, [], () => path(trail));
    if (mission) for (const log of mission.logs) paintLog(g, at, log);
    g.globalAlpha = 1;
    if (vehicle?.place) paintMachine(g, at, vehicle.place, vehicle.place_alive);
    for (const log of mission?.logs ?? []) if (mission.targets.includes(log.number)) paintName(g, at, log);
    paintScale(g, width, height);
  }

  function paintSite(g, at, path) {
    for (const fence of mission.fences) {
      stroke(g, fence.keep_out ? ink["stop-bright"] : ink.soft, 1.5, [8, 5], () => path(fence.corners, true));
    }
    stroke(g, ink.route, 2, [], () => path(mission.route, mission.closed));
    mission.route.forEach((p, i) => {
      if (mission.route.length > 40) return;
      const [x, y] = at(p);
      dot(g, x, y, 4, ink.route);
      label(g, String(i + 1), x + 7, y - 7, ink.soft);
    });
    for (const landing of mission.landings) {
      const [x, y] = at(landing.at);
      g.fillStyle = ink.log;
      g.fillRect(x - 7, y - 7, 14, 14);
      label(g, landing.name || "landing", x + 11, y + 4, ink.text);
    }
  }

  function paintLog(g, at, log) {
    const half = log.length_m / 2, c = Math.cos(log.yaw_rad), s = Math.sin(log.yaw_rad);
    const a = at([log.at[0] - half * c, log.at[1] - half * s]), b = at([log.at[0] + half * c, log.at[1] + half * s]);
    const wide = Math.max(3, log.diameter_m * scale), target = mission.targets.includes(log.number);
    const line = () => { g.beginPath(); g.moveTo(...a); g.lineTo(...b); };
    if (target) stroke(g, ink.target, wide + 7, [], line);
    stroke(g, log.given_up ? ink.soft : ink.log, wide, log.given_up ? [2, 5] : [], line);
  }

  /** The name of the target log, on its far side from the machine. */
  function paintName(g, at, log) {
    const [x, y] = at(log.at), place = vehicle?.place;
    const [px, py] = place ? at([place.x_m, place.y_m]) : [x, y + 1];
    const away = 24 / Math.max(1, Math.hypot(x - px, y - py));
    g.textAlign = "center";
    label(g, `log ${log.number}`, x + (x - px) * away * 1.4, y + (y - py) * away + 4, ink.text);
    g.textAlign = "left";
  }

  function paintMachine(g, at, place, known) {
    const color = known ? ink.good : ink.soft, c = carrier;
    const half = (yaw) => (x, y) => at([
      place.x_m + x * Math.cos(yaw) - y * Math.sin(yaw), place.y_m + x * Math.sin(yaw) + y * Math.cos(yaw)]);
    const front = half(place.front_rad), rear = half(place.rear_rad);
    const width = c.track_width_m / 2 - c.wheel_width_m / 2;
    const box = (to, x1, x2, y1, y2, fill) => {
      g.beginPath();
      [[x1, y1], [x2, y1], [x2, y2], [x1, y2]].forEach((p, i) => (i ? g.lineTo(...to(...p)) : g.moveTo(...to(...p))));
      g.closePath();
      g.fillStyle = fill;
      g.fill();
      g.strokeStyle = color;
      g.lineWidth = 1.5;
      g.stroke();
    };
    g.setLineDash([]);
    const yard = (x, y) => {
      const t = c.crane_yaw_rad;
      return rear(c.crane_base_m[0] + x * Math.cos(t) - y * Math.sin(t),
        c.crane_base_m[1] + x * Math.sin(t) + y * Math.cos(t));
    };
    const base = yard(0, 0);
    stroke(g, color, 1, [3, 5], () => { g.beginPath(); g.arc(...base, machine.reach_m * scale, 0, 2 * Math.PI); });
    for (const [to, axle] of [[front, c.front_axle_m], [rear, -c.rear_axle_m]]) {
      for (const side of [-1, 1]) {
        const y = (side * c.track_width_m) / 2;
        box(to, axle - c.wheel_radius_m, axle + c.wheel_radius_m, y - c.wheel_width_m / 2, y + c.wheel_width_m / 2,
          color);
      }
    }
    box(rear, -c.rear_axle_m - c.wheel_radius_m, -0.25, -width, width, ink.panel);
    box(front, 0.25, c.front_axle_m + c.wheel_radius_m, -width, width, ink.panel);
    const nose = c.front_axle_m + c.wheel_radius_m - 0.2;
    g.beginPath();
    [[nose, 0], [nose - 0.8, 0.45], [nose - 0.8, -0.45]].forEach((p, i) => (i ? g.lineTo(...front(...p)) : g.moveTo(...front(...p))));
    g.fillStyle = color;
    g.fill();
    const b = machine.bunk, t = b.yaw_rad;
    const bunk = (x, y) => yard(b.center_m[0] + x * Math.cos(t) - y * Math.sin(t),
      b.center_m[1] + x * Math.sin(t) + y * Math.cos(t));
    box(bunk, -b.length_m / 2, b.length_m / 2, -b.width_m / 2, b.width_m / 2, "transparent");
    if (points) {
      stroke(g, ink.reference, 3, [], () => {
        g.beginPath();
        points.forEach((p, i) => (i ? g.lineTo(...yard(p[0], p[1])) : g.moveTo(...yard(p[0], p[1]))));
      });
      const [x, y] = yard(points.at(-1)[0], points.at(-1)[1]);
      dot(g, x, y, 4, ink.reference);
    }
    dot(g, ...base, 3, color);
  }

  function paintScale(g, width, height) {
    const length = STEPS_M.findLast((m) => m * scale < 0.3 * width) ?? STEPS_M[0];
    const x = width - 16 - length * scale, y = height - 16;
    stroke(g, ink.text, 2, [], () => {
      g.beginPath();
      g.moveTo(x, y - 5); g.lineTo(x, y); g.lineTo(width - 16, y); g.lineTo(width - 16, y - 5);
    });
    g.textAlign = "right";
    label(g, `${length} m`, width - 16, y - 9, ink.text);
    g.textAlign = "center";
    const nx = width - 26, ny = 22;
    g.beginPath(); g.moveTo(nx, ny - 10); g.lineTo(nx + 6, ny + 8); g.lineTo(nx, ny + 4); g.lineTo(nx - 6, ny + 8);
    g.closePath(); g.fillStyle = ink.text; g.fill();
    label(g, "N", nx, ny + 22, ink.text);
    g.textAlign = "left";
  }

  function stroke(g, color, width, dash, line) {
    g.strokeStyle = color;
    g.lineWidth = width;
    g.setLineDash(dash);
    line();
    g.stroke();
    g.setLineDash([]);
  }

  function dot(g, x, y, radius, color) {
    g.beginPath(); g.arc(x, y, radius, 0, 2 * Math.PI);
    g.fillStyle = color;
    g.fill();
  }

  function label(g, text, x, y, color) {
    g.lineWidth = 3;
    g.strokeStyle = ink.halo;
    g.strokeText(text, x, y);
    g.fillStyle = color;
    g.fillText(text, x, y);
  }

  // ---- user input: drag, wheel, two fingers --------------------------------------------------------------

  const held = new Map();
  const spread = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  const movedByUser = () => { view = "free"; onMoved(); };
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); held.set(e.pointerId, [e.offsetX, e.offsetY]); });
  canvas.addEventListener("pointermove", (e) => {
    const before = held.get(e.pointerId);
    if (!before) return;
    const apart = held.size === 2 ? spread() : 0;
    held.set(e.pointerId, [e.offsetX, e.offsetY]);
    movedByUser();
    center = [center[0] - (e.offsetX - before[0]) / scale / held.size, center[1] + (e.offsetY - before[1]) / scale / held.size];
    if (apart) zoom(spread() / apart);
    draw();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => held.delete(e.pointerId));
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); movedByUser(); zoom(Math.exp(-e.deltaY / 500)); draw(); }, { passive: false });
  const zoom = (by) => { scale = Math.min(200, Math.max(0.05, scale * by)); };

  return {
    mission(report, isCurrent) { mission = report; current = isCurrent; },
    vehicle(now) {
      vehicle = now;
      const p = now?.place, last = trail.at(-1);
      if (p && (!last || Math.hypot(p.x_m - last[0], p.y_m - last[1]) > 0.25)) trail.push([p.x_m, p.y_m]);
      if (trail.length > carrier.trail_points) trail.splice(0, trail.length - carrier.trail_points);
      draw();
    },
    crane(chain) { points = chain; },
    trail(list) { trail = list; draw(); },
    view(name) { view = name; draw(); },
  };
}
