// 3-D view of the simulated plant: link shapes, logs, ground, numbers and the hand levers.
// World frame: metres, z up.  A pose is [x, y, z, qx, qy, qz, qw].

import * as THREE from "three";
import { createViewport, flatGround, paint, v3 } from "./viewport.js";

const LOST_AFTER_MS = 1500;
const LEVER_MS = 150;
const $ = (id) => document.getElementById(id);

function place(object, pose) {
  object.position.set(pose[0], pose[1], pose[2]);
  object.quaternion.set(pose[3], pose[4], pose[5], pose[6]);
}

/** Builds the scene; `update(state, follow)` moves it. */
function createView(container, scene) {
  const { world, camera, controls, draw, look } = createViewport(
    container, { nearest: 1, farthest: 80, sight: 300 });
  const sun = new THREE.DirectionalLight(0xfff4e0, 2.4);
  sun.position.set(8, -5, 14);
  world.add(new THREE.HemisphereLight(0xe9f5ff, 0x3a4a40, 1.4), sun, ground(scene.ground));

  const links = new Map();
  for (const shape of scene.shapes) {
    if (!links.has(shape.link)) links.set(shape.link, world.add(new THREE.Group()).children.at(-1));
    const [r, g, b] = shape.colour;
    const box = new THREE.Mesh(new THREE.BoxGeometry(...shape.size_m), paint(new THREE.Color(r, g, b).convertSRGBToLinear()));
    place(box, [...shape.position_m, ...shape.quaternion]);
    links.get(shape.link).add(box);
  }
  const wheels = (scene.wheels ?? []).map((wheel) => {
    const hub = new THREE.Group();
    const tyre = new THREE.Mesh(new THREE.CylinderGeometry(wheel.radius_m, wheel.radius_m, wheel.width_m, 28), paint(0x20241f));
    const mark = new THREE.Mesh(new THREE.BoxGeometry(1.3 * wheel.radius_m, 1.02 * wheel.width_m, 0.16), paint(0xd8a52e));
    hub.add(tyre, mark);
    world.add(hub);
    return hub;
  });
  const bark = paint(0x8a5a35), wood = paint(0xe2b883);
  const logs = scene.logs.map((log) => {
    const mesh = new THREE.Mesh(logShape(log), [bark, wood]);
    world.add(mesh);
    return mesh;
  });

  const centre = v3(scene.centre_m), size = scene.size_m;
  const VIEWS = {
    corner: [1.05, -1.0, 0.7], top: [0.0, -0.01, 1.9], side: [1.6, 0.0, 0.25],
  };

  function view(name) {
    look(centre.clone().addScaledVector(v3(VIEWS[name]), size), centre);
  }

  function update(state, follow) {
    for (const [name, pose] of Object.entries(state.poses)) {
      if (links.has(name)) place(links.get(name), pose);
    }
    state.logs.forEach((pose, i) => place(logs[i], pose));
    (state.wheels ?? []).forEach((pose, i) => place(wheels[i], pose));
    const grapple = state.poses.rotator;
    if (follow && grapple) {
      const shift = v3(grapple).sub(controls.target);
      controls.target.add(shift);
      camera.position.add(shift);
      controls.update();
    }
    draw();
  }

  view("corner");
  return { update, view };
}

/** A tapered, bowed log along its z axis: rings along the bow; one material group for the bark, one for the ends. */
function logShape({ length_m: length, diameter_m: diameter, taper_m_m: taper, sweep_m: sweep }) {
  const RINGS = 9, SIDES = 18, at = [], index = [];
  for (let i = 0; i < RINGS; i++) {
    const z = length * (i / (RINGS - 1) - 0.5), r = (diameter - taper * z) / 2;
    const bow = -sweep * ((2 * z) / length) ** 2;
    for (let k = 0; k < SIDES; k++) {
      const a = (2 * Math.PI * k) / SIDES;
      at.push(bow + r * Math.cos(a), r * Math.sin(a), z);
    }
  }
  for (let i = 0; i < RINGS - 1; i++) {
    for (let k = 0; k < SIDES; k++) {
      const a = i * SIDES + k, b = i * SIDES + (k + 1) % SIDES;
      index.push(a, b, a + SIDES, b, b + SIDES, a + SIDES);
    }
  }
  const sides = index.length;
  for (const [ring, flip] of [[0, true], [RINGS - 1, false]]) {
    const first = ring * SIDES, centre = at.length / 3;
    let x = 0;
    for (let k = 0; k < SIDES; k++) x += at[3 * (first + k)] / SIDES;
    at.push(x, 0, at[3 * first + 2]);
    for (let k = 0; k < SIDES; k++) {
      const a = first + k, b = first + (k + 1) % SIDES;
      index.push(centre, flip ? b : a, flip ? a : b);
    }
  }
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.Float32BufferAttribute(at, 3));
  shape.setIndex(index);
  shape.addGroup(0, sides, 0);
  shape.addGroup(sides, index.length - sides, 1);
  shape.computeVertexNormals();
  return shape;
}

/** Flat ground as a disc with a grid, rough ground as its height grid. */
function ground(g) {
  if (!g.heights) return flatGround(40, 60, g.z_m);
  const shape = new THREE.BufferGeometry(), at = [], index = [];
  for (let j = 0; j < g.rows; j++) {
    for (let i = 0; i < g.columns; i++) at.push(g.x0_m + i * g.cell_m, g.y0_m + j * g.cell_m, g.heights[j * g.columns + i]);
  }
  for (let j = 0; j < g.rows - 1; j++) {
    for (let i = 0; i < g.columns - 1; i++) {
      const a = j * g.columns + i, b = a + g.columns;
      index.push(a, a + 1, b, a + 1, b + 1, b);
    }
  }
  shape.setAttribute("position", new THREE.Float32BufferAttribute(at, 3));
  shape.setIndex(index);
  shape.computeVertexNormals();
  return new THREE.Mesh(shape, paint(0x3d4f3a));
}

// ---- numbers -----------------------------------------------------------------------------------------------

function showFacts(facts) {
  const list = $("facts");
  for (const [name, value] of Object.entries(facts)) {
    let dd = list.querySelector(`[data-name="${CSS.escape(name)}"]`);
    if (!dd) {
      const tile = list.appendChild(document.createElement("div"));
      tile.appendChild(document.createElement("dt")).textContent = name;
      dd = tile.appendChild(document.createElement("dd"));
      dd.dataset.name = name;
    }
    dd.textContent = value;
  }
}

function showPressures(pressures) {
  const body = document.querySelector("#pressures tbody");
  const most = 250;
  for (const [name, [a, b]] of Object.entries(pressures)) {
    let row = body.querySelector(`[data-name="${CSS.escape(name)}"]`);
    if (!row) {
      row = body.appendChild(document.createElement("tr"));
      row.dataset.name = name;
      row.appendChild(document.createElement("td")).textContent = name;
      const bar = row.appendChild(document.createElement("td")).appendChild(document.createElement("div"));
      bar.className = "bar";
      bar.append(document.createElement("i"), document.createElement("u"));
      row.appendChild(document.createElement("td"));
    }
    row.querySelector("i").style.width = `${Math.min(100, (100 * a) / most)}%`;
    row.querySelector("u").style.left = `${Math.min(100, (100 * b) / most)}%`;
    row.lastChild.textContent = `${a.toFixed(0)} · ${b.toFixed(0)}`;
  }
}

// ---- levers ------------------------------------------------------------------------------------------------

async function pull(name, value) {
  try {
    const query = new URLSearchParams({ name, value });
    const answer = await fetch(`api/plant/lever?${query}`, { method: "POST", signal: AbortSignal.timeout(1500) });
    $("refusal").textContent = answer.ok ? "" : await answer.text();
  } catch (error) {
    $("refusal").textContent = `The lever could not be moved: ${error.message}`;
  }
}

function buildLevers(levers) {
  for (const { name, minus, plus } of levers) {
    const label = $("levers").appendChild(document.createElement("span"));
    label.textContent = name;
    for (const [word, value] of [[minus, "-0.6"], [plus, "0.6"]]) {
      const button = $("levers").appendChild(document.createElement("button"));
      button.type = "button";
      button.textContent = word;
      button.setAttribute("aria-label", `${name} ${word}`);
      let timer = 0;
      const release = () => {
        if (!timer) return;
        clearInterval(timer);
        timer = 0;
        button.classList.remove("held");
        pull(name, "0");
      };
      button.addEventListener("pointerdown", () => {
        button.classList.add("held");
        pull(name, value);
        timer ||= setInterval(() => pull(name, value), LEVER_MS);
      });
      for (const end of ["pointerup", "pointerleave", "pointercancel", "blur"]) button.addEventListener(end, release);
    }
  }
}

// ---- link --------------------------------------------------------------------------------------------------

let view = null, received = 0, follow = false;

function connect() {
  const url = new URL("ws/plant", location.href);
  url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  const socket = new WebSocket(url);
  socket.addEventListener("message", (event) => {
    const state = JSON.parse(event.data);
    if (!state) return;
    received = performance.now();
    $("clock").textContent = `${state.time_s.toFixed(1)} s`;
    view?.update(state, follow);
    showFacts(state.facts);
    showPressures(state.pressures_bar);
  });
  socket.addEventListener("close", () => setTimeout(connect, 500));
}

function watch() {
  const alive = performance.now() - received < LOST_AFTER_MS;
  document.body.dataset.link = alive ? "ok" : "lost";
  if (!alive) $("clock").textContent = "NO CONNECTION";
  $("alarm").hidden = alive || !received;
  $("alarm").textContent = "No data from the plant: the display is outdated.";
}

async function start() {
  const answer = await fetch("api/plant");
  if (!answer.ok) throw new Error(await answer.text());
  const scene = await answer.json();
  $("title").textContent = scene.title;
  buildLevers(scene.levers);
  connect();
  setInterval(watch, 200);
  try {
    view = createView($("scene"), scene);
    for (const button of document.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => {
        document.querySelectorAll("[data-view]").forEach((b) => b.setAttribute("aria-pressed", b === button));
        view.view(button.dataset.view);
      });
    }
    $("follow").addEventListener("click", () => {
      follow = !follow;
      $("follow").setAttribute("aria-pressed", follow);
    });
  } catch (error) {
    const note = document.createElement("p");
    note.textContent = `The 3-D view needs WebGL and is not available here (${error.message}). The numbers are still updated.`;
    $("scene").replaceChildren(note);
  }
}

start().catch((error) => {
  $("alarm").hidden = false;
  $("alarm").textContent = `The page could not start: ${error.message}`;
});
