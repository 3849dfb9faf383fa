// 3-D view of crane, ground, bunk and logs, in the base frame of the crane: metres, z up.

import * as THREE from "three";
import { createCarrier } from "./carrier.js";
import { createViewport, flatGround, paint, v3 } from "./viewport.js";

const CRANE = 0xe0a22e, STEEL = 0x8b979f, DARK = 0x39443f, BARK = 0x8a5a35, WOOD = 0xe2b883, GHOST = 0xcfe3ff, GRIP = 0xff9ec4, TRUE = 0x40e0ff;
const UP = new THREE.Vector3(0, 1, 0);
/** The views fit a crane of this reach; a longer one is seen from farther away. */
const VIEWED_M = 6.95;
/** View target of a machine that drives, which works on all sides. */
const VEHICLE = [0.5, 0, 0.5];
const VIEWS = {
  corner: [[6.8, 9.4, 4.9], [0.75, 2.2, 0.7]],
  top: [[0.6, 2.3, 12], [0.6, 2.31, 0]],
  side: [[10.5, 2.6, 1.4], [0, 2.6, 0.7]],
};

/** A bar between two movable end points, round or square. */
class Bar {
  constructor(parent, radius, color, square = false) {
    const shape = square
      ? new THREE.CylinderGeometry(radius * 1.25, radius * 1.25, 1, 4, 1).rotateY(Math.PI / 4)
      : new THREE.CylinderGeometry(radius, radius, 1, 20, 1);
    if (square) shape.computeVertexNormals();
    this.mesh = new THREE.Mesh(square ? shape.toNonIndexed() : shape, paint(color));
    if (square) this.mesh.geometry.computeVertexNormals();
    parent.add(this.mesh);
  }
  span(a, b) {
    const along = b.clone().sub(a);
    this.mesh.position.copy(a).addScaledVector(along, 0.5);
    this.mesh.scale.y = Math.max(along.length(), 1e-3);
    this.mesh.quaternion.setFromUnitVectors(UP, along.normalize());
  }
}

function ball(parent, radius, color) {
  const mesh = new THREE.Mesh(new THREE.SphereGeometry(radius, 20, 14), paint(color));
  parent.add(mesh);
  return mesh;
}

class Crane {
  constructor(parent, machine) {
    this.machine = machine;
    this.pedestal = new Bar(parent, 0.3, DARK, true);
    const foot = machine.carrier ? 0.25 - machine.carrier.crane_base_m[2] : machine.ground_z_m;
    this.pedestal.span(new THREE.Vector3(0, 0, foot), new THREE.Vector3(0, 0, 0.05));
    this.column = new Bar(parent, 0.17, CRANE);
    this.boom = new Bar(parent, 0.115, CRANE, true);
    this.stick = new Bar(parent, 0.095, CRANE, true);
    this.telescope = new Bar(parent, 0.06, STEEL, true);
    this.link = new Bar(parent, 0.035, STEEL);
    this.rotator = new Bar(parent, 0.11, DARK);
    this.body = new Bar(parent, 0.07, CRANE, true);
    this.pins = [0.15, 0.14, 0.07].map((r) => ball(parent, r, STEEL));
    this.jaws = [0, 1].map(() => [new Bar(parent, 0.045, CRANE), new Bar(parent, 0.035, STEEL)]);
    this.knees = [0, 1].map(() => ball(parent, 0.047, CRANE));
  }
  update(points, jaws) {
    const [base, boomPin, stickPin, front, pin, rotator, grapple] = points.map(v3);
    const axis = pin.clone().sub(front).normalize();
    const back = front.clone().addScaledVector(axis, -axis.dot(front.clone().sub(stickPin)));
    this.column.span(base, new THREE.Vector3(0, 0, boomPin.z + 0.1));
    this.boom.span(boomPin, stickPin);
    this.stick.span(back, front);
    this.telescope.span(back, pin);
    this.link.span(pin, rotator);
    this.rotator.span(rotator.clone().setZ(rotator.z + 0.1), rotator.clone().setZ(rotator.z - 0.08));
    [boomPin, stickPin, pin].forEach((p, i) => this.pins[i].position.copy(p));
    const open = new THREE.Vector3(Math.cos(jaws.yaw_rad), Math.sin(jaws.yaw_rad), 0);
    const at = (x, below) => pin.clone().addScaledVector(open, x).setZ(pin.z - below);
    const depth = pin.z - grapple.z;
    this.body.span(at(-0.3, depth), at(0.3, depth));
    [-1, 1].forEach((side, i) => {
      const pivot = at(side * 0.275, depth), tip = at(side * jaws.half_gap_m, jaws.tip_below_m);
      const outward = Math.max(0.12, 0.5 * Math.abs(jaws.half_gap_m));
      const knee = at(side * (0.275 + outward), depth + 0.45 * (jaws.tip_below_m - depth));
      this.jaws[i][0].span(pivot, knee);
      this.jaws[i][1].span(knee, tip);
      this.knees[i].position.copy(knee);
    });
  }
}

/** The ground, with the picking area of a stationary machine; returns the group to move. */
function addGround(scene, machine) {
  const z = machine.ground_z_m, ground = flatGround(14, 20, z);
  scene.add(ground);
  if (machine.carrier) return ground;
  const [x, y] = machine.pick_center_m, h = machine.pick_half_size_m;
  const corners = [[-h, -h], [h, -h], [h, h], [-h, h]].map(([a, b]) => new THREE.Vector3(x + a, y + b, z + 0.01));
  ground.add(new THREE.LineLoop(
    new THREE.BufferGeometry().setFromPoints(corners), new THREE.LineBasicMaterial({ color: 0x6fdc98 })));
  return ground;
}

function addBunk(scene, machine) {
  const b = machine.bunk;
  const group = new THREE.Group();
  group.position.set(b.center_m[0], b.center_m[1], b.floor_z_m);
  group.rotation.z = b.yaw_rad;
  const floor = new THREE.Mesh(new THREE.BoxGeometry(b.length_m, b.width_m, 0.1), paint(0x4a5952));
  floor.position.z = -0.05;
  group.add(floor);
  const frame = machine.carrier ? 0.25 - machine.carrier.crane_base_m[2] : machine.ground_z_m;
  const legs = Math.max(b.floor_z_m - frame - 0.1, 0.02);
  for (const sx of [-0.35, 0.35]) {
    for (const sy of [-0.5, 0.5]) {
      const stake = new Bar(group, 0.045, STEEL, true);
      const x = sx * b.length_m, y = sy * b.width_m;
      stake.span(new THREE.Vector3(x, y, 0), new THREE.Vector3(x, y, b.stake_height_m));
    }
    const sill = new THREE.Mesh(new THREE.BoxGeometry(0.16, b.width_m, legs), paint(DARK));
    sill.position.set(sx * b.length_m, 0, -0.1 - legs / 2);
    group.add(sill);
  }
  scene.add(group);
}

/** The chosen grasp: the open jaws' tips, and the pin above them; returns `show(grasp)`. */
function createGrip(scene) {
  const group = new THREE.Group(), tips = [0, 1].map(() => ball(group, 0.07, GRIP));
  const across = new Bar(group, 0.025, GRIP), down = new Bar(group, 0.018, GRIP);
  group.visible = false;
  scene.add(group);
  return (grasp) => {
    group.visible = Boolean(grasp);
    if (!grasp) return;
    const [a, b] = grasp.tips.map(v3), pin = v3(grasp.pin);
    tips.forEach((tip, i) => tip.position.copy(i ? b : a));
    across.span(a, b);
    down.span(pin, a.clone().lerp(b, 0.5));
  };
}

const SIDES = 24;
const ROUND = new THREE.CylinderGeometry(1, 1, 1, SIDES);  // scaled to each log

/** Calls `place(i, matrix)` for every log of a list that is not the one shown; returns `show(list)`. */
function onChange(begin, place) {
  let shown = "";
  const matrix = new THREE.Matrix4(), turn = new THREE.Quaternion(), size = new THREE.Vector3();
  return (list) => {
    const key = JSON.stringify(list);
    if (key === shown) return;
    shown = key;
    begin(list.length);
    list.forEach((log, i) => {
      turn.setFromUnitVectors(UP, v3(log.axis).normalize());
      size.set(log.diameter_m / 2, log.length_m, log.diameter_m / 2);
      place(i, matrix.compose(v3(log.center_m), turn, size));
    });
  };
}

/** Logs of bark and wood, drawn all at once: a heap of 200 costs no more calls than one log. */
function createLogs(scene) {
  const materials = [paint(BARK), paint(WOOD), paint(WOOD)];
  let logs = null;
  return onChange((count) => {
    if (count > (logs?.instanceMatrix.count ?? 0)) {
      if (logs) { scene.remove(logs); logs.dispose(); }
      logs = new THREE.InstancedMesh(ROUND, materials, 2 * count);
      logs.frustumCulled = false;
      scene.add(logs);
    }
    if (logs) { logs.count = count; logs.instanceMatrix.needsUpdate = true; }
  }, (i, matrix) => logs.setMatrixAt(i, matrix));
}

/** Logs as they are in the plant: edges only, so that what is perceived stays visible in and behind them. */
function createTrueLogs(scene) {
  const edges = new THREE.EdgesGeometry(ROUND, 10).getAttribute("position"), end = new THREE.Vector3();
  const lines = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: TRUE }));
  lines.frustumCulled = false;
  scene.add(lines);
  let points = null;
  return onChange((count) => {
    lines.geometry.dispose();
    lines.geometry = new THREE.BufferGeometry();
    points = new THREE.BufferAttribute(new Float32Array(3 * count * edges.count), 3);
    lines.geometry.setAttribute("position", points);
  }, (i, matrix) => {
    for (let k = 0; k < edges.count; k++) {
      end.fromBufferAttribute(edges, k).applyMatrix4(matrix);
      points.setXYZ(i * edges.count + k, end.x, end.y, end.z);
    }
  });
}

/** Builds the view into `container`; returns `{update(state), view(name), trueLogs(list)}`.  Throws without WebGL. */
export function createScene(container, machine) {
  const { world: scene, draw, look } = createViewport(container, { nearest: 2, farthest: 30, sight: 80 });
  const sun = new THREE.DirectionalLight(0xffffff, 2.2);
  sun.position.set(6, 3, 12);
  scene.add(new THREE.HemisphereLight(0xe9f5ff, 0x3a4a40, 1.5), sun);
  const ground = addGround(scene, machine);
  const carrier = machine.carrier ? createCarrier(scene, machine, ground) : null;
  addBunk(scene, machine);
  const craneGroup = new THREE.Group();
  craneGroup.visible = false;
  scene.add(craneGroup);
  const crane = new Crane(craneGroup, machine);
  const ghost = new THREE.Line(
    new THREE.BufferGeometry(), new THREE.LineDashedMaterial({ color: GHOST, dashSize: 0.14, gapSize: 0.08 }));
  const ghostPin = new THREE.Mesh(
    new THREE.SphereGeometry(0.12, 12, 8), new THREE.MeshBasicMaterial({ color: GHOST, wireframe: true }));
  ghost.frustumCulled = false;
  ghost.visible = ghostPin.visible = false;
  scene.add(ghost, ghostPin);
  const grip = createGrip(scene);

  function view(name) {
    const [position, target] = VIEWS[name];
    const off = v3(position).sub(v3(target)).multiplyScalar(Math.max(1, machine.reach_m / VIEWED_M));
    const at = v3(machine.carrier ? VEHICLE : target);
    if (machine.carrier) off.applyAxisAngle(new THREE.Vector3(0, 0, 1), Math.PI / 2);
    look(off.add(at), at);
  }

  const showLogs = createLogs(scene), showTrueLogs = createTrueLogs(scene);

  function update(state) {
    // An unknown pose is not drawn.
    craneGroup.visible = Boolean(state.points);
    if (state.points) crane.update(state.points, state.jaws);
    ghost.visible = Boolean(state.reference_points);
    ghostPin.visible = ghost.visible && v3(state.reference_points[4]).distanceTo(v3(state.points[4])) > 0.1;
    if (state.reference_points) {
      const points = state.reference_points.map(v3);
      ghost.geometry.dispose();
      ghost.geometry = new THREE.BufferGeometry().setFromPoints(points);
      ghost.computeLineDistances();
      ghostPin.position.copy(points[4]);
    }
    carrier?.update(state.vehicle);
    showLogs(state.logs);
    grip(state.grasp);
    draw();
  }

  view("corner");
  return { update, view, trueLogs(list) { showTrueLogs(list); draw(); } };
}
