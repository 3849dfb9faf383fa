// The carrier in the 3-D view: rear frame with the bunk, articulated front half, four wheels on their swing arms, and the
// ground at the height of the wheels.  Group `rear` is the rear frame: x ahead, y left, origin on the articulation axis.

import * as THREE from "three";
import { paint } from "./viewport.js";

const PAINT = 0x3f7d5a, DARK = 0x39443f, TYRE = 0x2c322e, HUB = 0xd8a52e, GLASS = 0x8fb7c9;
const HALF_FRAME_M = 0.45;

function box(parent, [x, y, z], size, color) {
  const mesh = new THREE.Mesh(new THREE.BoxGeometry(...size), paint(color));
  mesh.position.set(x, y, z);
  parent.add(mesh);
}

/** A wheel on its swing arm; `update(height)` sets the frame height above its lowest position [m]. */
function createWheel(parent, c, axle, side) {
  const wheel = new THREE.Group(), y = (side * c.track_width_m) / 2;
  const tyre = new THREE.CylinderGeometry(c.wheel_radius_m, c.wheel_radius_m, c.wheel_width_m, 28);
  wheel.add(new THREE.Mesh(tyre, paint(TYRE)));
  const hub = new THREE.CylinderGeometry(0.4 * c.wheel_radius_m, 0.4 * c.wheel_radius_m, 1.02 * c.wheel_width_m, 20);
  wheel.add(new THREE.Mesh(hub, paint(HUB)));
  const arm = new THREE.Mesh(new THREE.BoxGeometry(0.22, 0.12, 1), paint(DARK));
  parent.add(wheel, arm);
  return {
    update(height) {
      const z = -c.arm_drop_low_m - height;
      wheel.position.set(axle, y, z);
      arm.position.set(axle, side * (HALF_FRAME_M + 0.08), z / 2);
      arm.scale.z = Math.max(Math.abs(z), 0.2);
    },
  };
}

/** Adds the carrier to `scene`; `update(vehicle)` sets articulation and heights, and moves `ground` below the wheels. */
export function createCarrier(scene, machine, ground) {
  const c = machine.carrier, [x, y, z] = c.crane_base_m, turn = -c.crane_yaw_rad;
  const rear = new THREE.Group(), front = new THREE.Group();
  rear.rotation.z = turn;
  rear.position.set(-x, -y, -z).applyAxisAngle(new THREE.Vector3(0, 0, 1), turn);
  rear.add(front);
  scene.add(rear);
  const b = machine.bunk, [bx, by] = b.center_m;
  const middle = x + Math.cos(turn) * bx + Math.sin(turn) * by;
  const behind = Math.max(c.rear_axle_m + c.wheel_radius_m, b.length_m / 2 - middle), ahead = c.front_axle_m + 0.85;
  box(rear, [-behind / 2 - 0.1, 0, 0.12], [behind - 0.2, 2 * HALF_FRAME_M, 0.3], PAINT);
  box(front, [ahead / 2 + 0.1, 0, 0.12], [ahead - 0.2, 2 * HALF_FRAME_M, 0.3], PAINT);
  box(front, [ahead / 2 + 0.35, 0, 0.66], [ahead - 0.8, 1.2, 0.8], PAINT);
  box(front, [ahead - 0.04, 0, 0.7], [0.06, 0.9, 0.5], GLASS);
  const joint = new THREE.Mesh(new THREE.CylinderGeometry(0.16, 0.16, 0.5, 20), paint(DARK));
  joint.rotation.x = Math.PI / 2;
  joint.position.z = 0.12;
  rear.add(joint);
  const wheels = [[front, c.front_axle_m, 1], [front, c.front_axle_m, -1], [rear, -c.rear_axle_m, 1], [rear, -c.rear_axle_m, -1]]
    .map(([half, axle, side]) => createWheel(half, c, axle, side));

  function update(vehicle) {
    const bend = vehicle?.articulation_deg ?? 0, heights = vehicle?.heights_m ?? [];
    front.rotation.z = (bend * Math.PI) / 180;
    const known = heights.filter((h) => h !== null);
    const mean = known.length ? known.reduce((a, b) => a + b, 0) / known.length : c.arm_transport_m;
    wheels.forEach((wheel, i) => wheel.update(heights[i] ?? mean));
    ground.position.z = -mean;
  }

  update(null);
  return { update };
}
