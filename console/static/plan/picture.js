// A picture of the site under the grid, such as an aerial photograph: a local file, north up, placed by three numbers.
// It is drawn on the grid's canvas and never leaves the browser.

import { createFields, number } from "./fields.js";

const $ = (id) => document.getElementById(id);
const PLACE = [
  { key: "west_m", label: "left edge, east m", as: number },
  { key: "south_m", label: "bottom edge, north m", as: number },
  { key: "width_m", label: "width m", as: number },
];

/** `grid.picture(bitmap, {west_m, south_m, width_m})` draws it, `grid.picture(null)` takes it away. */
export function createPicture(grid, complain) {
  let bitmap = null, place = { west_m: -50, south_m: -50, width_m: 100 };
  const fields = createFields($("picture-place"), "picture", complain, (field, value) => {
    if (value === null || (field.key === "width_m" && !(value > 0))) complain(`${field.label}: give a number${field.key === "width_m" ? " above 0" : ""}.`);
    else place = { ...place, [field.key]: value };
    show();
  });

  function show() {
    fields.show(bitmap ? PLACE : [], place);
    $("picture-off").disabled = !bitmap;
    grid.picture(bitmap, place);
  }

  $("picture").addEventListener("change", async () => {
    const file = $("picture").files[0];
    if (!file) return;
    try {
      bitmap = await createImageBitmap(file);
    } catch { complain(`${file.name} is not a picture that this browser can show; use PNG, JPEG or WebP.`); }
    show();
  });
  $("picture-off").addEventListener("click", () => {
    bitmap = null;
    $("picture").value = "";
    show();
  });
  show();
}
