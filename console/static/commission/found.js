// What a calibration has found: every value before and after, and the plots of its report.

const $ = (id) => document.getElementById(id);
let shown = "";

export function showFound(found) {
  $("found").hidden = !found;
  if (!found || found.name === shown) return;
  shown = found.name;
  $("changes").tBodies[0].replaceChildren(...found.changes.map(row));
  $("plots").replaceChildren(...found.plots.map((name) => plot(name, found.name)));
}

function row(change) {
  const made = document.createElement("tr");
  for (const words of [change.key, value(change.before), value(change.after)]) made.insertCell().textContent = words;
  const remark = document.createElement("small");
  remark.textContent = change.remark;
  made.cells[0].append(remark);
  return made;
}

function value(told) {
  if (told === null) return "–";
  if (Array.isArray(told)) return told.map(value).join(" · ");
  return typeof told === "number" ? String(Number(told.toPrecision(5))) : String(told);
}

function plot(name, run) {
  const link = document.createElement("a"), picture = document.createElement("img");
  link.href = picture.src = `api/commission/plots/${encodeURIComponent(name)}?${encodeURIComponent(run)}`;
  link.target = "_blank";
  picture.alt = `Fit of the ${name.replace(/\.png$/, "")}`;
  picture.loading = "lazy";
  link.append(picture);
  return link;
}
