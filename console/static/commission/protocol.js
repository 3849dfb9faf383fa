// The acceptance protocol: a form with a line for each check, saved once under its name, opened again, printed.

import { post } from "../access.js";

const $ = (id) => document.getElementById(id);
const RESULTS = [["open", "open"], ["pass", "pass"], ["fail", "fail"]];
const HEADS = ["machine", "inspector", "place"], DEGREES = 180 / Math.PI;

/** Builds the form from the server's checks; `measured(steps, joints)` shows what goes with it. */
export function createProtocol(settings, alarm) {
  const rows = settings.checks.map((check) => {
    const tr = document.createElement("tr"), cell = () => tr.appendChild(document.createElement("td"));
    const what = cell(), result = document.createElement("select"), value = document.createElement("input"), remark = document.createElement("input");
    what.append(check.title, Object.assign(document.createElement("small"), { textContent: check.how }));
    result.append(...RESULTS.map(([id, words]) => new Option(words, id)));
    result.setAttribute("aria-label", `${check.title}: result`);
    result.dataset.check = check.id;
    result.addEventListener("change", () => { result.dataset.result = result.value; });
    value.setAttribute("aria-label", `${check.title}: ${check.value || "value"}`);
    value.placeholder = check.value;
    value.disabled = !check.value;
    value.maxLength = 80;
    remark.setAttribute("aria-label", `${check.title}: remark`);
    remark.maxLength = 400;
    for (const field of [result, value, remark]) cell().append(field);
    return { id: check.id, tr, result, value, remark };
  });
  $("checks").querySelector("tbody").replaceChildren(...rows.map((row) => row.tr));
  $("protocol-facts").textContent = `${settings.profile}, profile ${settings.hash}, kept in ${settings.folder}`;
  $("name").value = `${settings.profile}-${new Date().toISOString().slice(0, 10)}`;

  function filled() {
    const entries = rows.map((row) => ({ id: row.id, result: row.result.value, value: row.value.value, remark: row.remark.value }));
    return { entries, ...Object.fromEntries(HEADS.map((id) => [id, $(id).value])) };
  }

  function show(told) {
    for (const id of HEADS) $(id).value = told[id];
    for (const entry of told.entries) {
      const row = rows.find((r) => r.id === entry.id);
      if (!row) continue;
      row.result.value = row.result.dataset.result = entry.result;
      row.value.value = entry.value;
      row.remark.value = entry.remark;
    }
    judged(told);
  }

  function judged(told) {
    const verdict = Object.assign(document.createElement("b"), { textContent: told.verdict });
    const who = told.saved_by ? ` by ${told.saved_by}` : "";
    $("verdict").replaceChildren(verdict, ` ${told.name}, saved ${told.saved_at.slice(0, 16).replace("T", " ")} UTC${who}. ${told.reasons.join(" ")}`);
    $("verdict").classList.toggle("bad", told.verdict === "refused");
  }

  $("protocol-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      const answer = await post(`api/commission/protocols/${encodeURIComponent($("name").value)}`, { body: JSON.stringify(filled()) });
      if (!answer.ok) throw new Error(await answer.text());
      judged(await answer.json());
      await list();
    } catch (error) { alarm(error.message); }
  });
  $("print").addEventListener("click", () => window.print());
  $("open").addEventListener("click", async () => {
    const answer = await fetch(`api/commission/protocols/${encodeURIComponent($("saved").value)}`);
    if (answer.ok) show(await answer.json()); else alarm("This protocol cannot be read.");
  });

  async function list() {
    const names = await (await fetch("api/commission/protocols")).json();
    $("saved").replaceChildren(...(names.length ? names.map((name) => new Option(name, name)) : [new Option("none yet", "")]));
    $("saved").disabled = $("open").disabled = !names.length;
  }
  list().catch((error) => alarm(error.message));

  function measured(steps, joints) {
    const words = joints.filter((j) => steps[j.name]).map((j) => {
      const error = steps[j.name].figures.largest_error;
      return `${j.name} ${j.unit === "m" ? `${(error * 1000).toFixed(0)} mm` : `${(error * DEGREES).toFixed(2)}°`}`;
    });
    const told = words.length ? `Steps that go with it, largest error: ${words.join(", ")}.` : "No joint has been stepped yet; what steps show goes with the protocol.";
    if ($("measured").textContent !== told) $("measured").textContent = told;
  }
  return { measured };
}
