// 3-D viewport: renderer, camera and controls; draws on change.  Metres, z up.

import * as THREE from "three";
import { OrbitControls } from "./vendor/OrbitControls.js";

export const paint = (color) => new THREE.MeshLambertMaterial({ color });
export const v3 = (p) => new THREE.Vector3(p[0], p[1], p[2]);

/** Flat ground at height `z`: a disc of `radius`, and a grid of `cells` squares of 1 m along each side. */
export function flatGround(radius, cells, z) {
  const group = new THREE.Group();
  const disc = new THREE.Mesh(new THREE.CircleGeometry(radius, 64), paint(0x22302a));
  disc.position.z = z - 0.01;
  const grid = new THREE.GridHelper(cells, cells, 0x51655b, 0x33443c);
  grid.rotation.x = Math.PI / 2;
  grid.position.z = z;
  return group.add(disc, grid);
}

/** Fills `container`; returns `{world, camera, controls, draw, look(position, target)}`.  Throws without WebGL. */
export function createViewport(container, { nearest, farthest, sight }) {
  const renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
  container.replaceChildren(renderer.domElement);

  const world = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(42, 1, 0.1, sight);
  camera.up.set(0, 0, 1);
  const controls = new OrbitControls(camera, renderer.domElement);
  controls.minDistance = nearest;
  controls.maxDistance = farthest;

  let scheduled = false;
  function draw() {
    if (scheduled) return;
    scheduled = true;
    requestAnimationFrame(() => {
      scheduled = false;
      renderer.render(world, camera);
      const { calls, triangles } = renderer.info.render;  // tests read these counts, which no other load changes
      Object.assign(container.dataset, { calls, triangles });
    });
  }
  controls.addEventListener("change", draw);
  new ResizeObserver(() => {
    const { clientWidth: w, clientHeight: h } = container;
    if (!w || !h) return;
    renderer.setSize(w, h);
    camera.aspect = w / h;
    // Keeps the reach of the crane on both sides in view, also in a tall panel.
    camera.fov = Math.max(42, 2 * Math.atan(0.58 * h / w) * 180 / Math.PI);
    camera.updateProjectionMatrix();
    draw();
  }).observe(container);

  function look(position, target) {
    camera.position.copy(position);
    controls.target.copy(target);
    controls.update();
    draw();
  }
  return { world, camera, controls, draw, look };
}
