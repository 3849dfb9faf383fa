// The grid under the plan: lines every 1, 2 or 5 times a power of ten metres, with their distance from the origin.

const STEPS = [1, 2, 5], LEAST_PX = 70;

/** Adds a canvas below the drawing of a Leaflet map in metres (CRS.Simple); returns `{picture(bitmap, place)}`. */
export function addGrid(map) {
  const canvas = document.createElement("canvas");
  canvas.className = "grid";
  canvas.setAttribute("aria-hidden", "true");
  map.getContainer().prepend(canvas);
  let under = null, at = null;

  function draw() {
    const { x: w, y: h } = map.getSize(), ratio = window.devicePixelRatio || 1;
    if (canvas.width !== w * ratio || canvas.height !== h * ratio) {
      canvas.width = w * ratio;
      canvas.height = h * ratio;
    }
    const g = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
    const color = (name) => style.getPropertyValue(`--${name}`);
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    if (under) {
      const corner = map.latLngToContainerPoint([at.south_m, at.west_m]);
      const w_px = map.latLngToContainerPoint([0, at.width_m]).x - map.latLngToContainerPoint([0, 0]).x;
      const h_px = (w_px * under.height) / under.width;
      g.globalAlpha = 0.75;
      g.drawImage(under, corner.x, corner.y - h_px, w_px, h_px);
      g.globalAlpha = 1;
    }
    g.font = "11px system-ui, sans-serif";
    const low = map.containerPointToLatLng([0, h]), high = map.containerPointToLatLng([w, 0]);
    const step = stepFor(LEAST_PX * (high.lng - low.lng) / w);
    const lines = (from, to, draw_) => {
      for (let k = Math.ceil(from / step); k * step <= to; k++) draw_(k * step);
    };
    const stroke = (x0, y0, x1, y1, zero) => {
      g.strokeStyle = color(zero ? "mark" : "line");
      g.lineWidth = zero ? 1.5 : 1;
      g.beginPath();
      g.moveTo(x0, y0);
      g.lineTo(x1, y1);
      g.stroke();
    };
    g.fillStyle = color("soft");
    lines(low.lng, high.lng, (east) => {
      const x = Math.round(map.latLngToContainerPoint([0, east]).x) + 0.5;
      stroke(x, 0, x, h, east === 0);
      g.fillText(label(east), x + 3, h - 5);
    });
    lines(low.lat, high.lat, (north) => {
      const y = Math.round(map.latLngToContainerPoint([north, 0]).y) + 0.5;
      stroke(0, y, w, y, north === 0);
      if (y < h - 24) g.fillText(label(north), 4, y - 3);
    });
  }
  map.on("move zoom resize viewreset", draw);
  matchMedia("(prefers-color-scheme: light)").addEventListener("change", draw);
  draw();
  return { picture(bitmap, place) { under = bitmap; at = place; draw(); } };
}

function stepFor(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return (STEPS.find((s) => s * power >= least) ?? 10) * power;
}

const label = (m) => (Math.abs(m) < 1e-9 ? "0" : `${+m.toPrecision(8)}`.replace("-", "−"));
