// WGS84 to metres east and north of an origin and back: the local tangent plane of autonomy/missions/local_frame.py.

const A_M = 6378137, E2 = 0.00669437999014132;
const RAD = Math.PI / 180;

/** Earth-centred coordinates of a place at height `h` [m]. */
function centred(latitude, longitude, h) {
  const s = Math.sin(latitude * RAD), c = Math.cos(latitude * RAD), n = A_M / Math.sqrt(1 - E2 * s * s);
  return [(n + h) * c * Math.cos(longitude * RAD), (n + h) * c * Math.sin(longitude * RAD), (n * (1 - E2) + h) * s];
}

/** A frame about an origin: `local(point)` is [east, north], `point(east, north)` the place, both at height 0. */
export function createFrame(latitude, longitude) {
  const origin = centred(latitude, longitude, 0);
  const [s, c] = [Math.sin(latitude * RAD), Math.cos(latitude * RAD)];
  const [u, v] = [Math.sin(longitude * RAD), Math.cos(longitude * RAD)];
  const across = A_M / Math.sqrt(1 - E2 * s * s), along = (across * (1 - E2)) / (1 - E2 * s * s);

  function local(point) {
    const [x, y, z] = centred(point.latitude_deg, point.longitude_deg, point.altitude_m ?? 0).map((w, i) => w - origin[i]);
    return [-u * x + v * y, -s * v * x - s * u * y + c * z];
  }

  /** Newton steps with the scale at the origin; four of them are exact to a micrometre within 20 km. */
  function place(east, north) {
    const found = { latitude_deg: latitude, longitude_deg: longitude, altitude_m: null };
    for (let k = 0; k < 6; k++) {
      const [e, n] = local(found);
      found.latitude_deg += (north - n) / along / RAD;
      found.longitude_deg += (east - e) / (across * Math.max(0.02, Math.cos(found.latitude_deg * RAD))) / RAD;
    }
    return found;
  }
  return { latitude, longitude, local, point: place };
}
