// Try to break it: buttons for faults of a simulated run, and a card of what became of the last one.

import { post } from "./access.js";

const AGAIN_MS = 2000;

const add = (parent, name, className = "", words = "") => {
  const element = parent.appendChild(document.createElement(name));
  if (className) element.className = className;
  element.textContent = words;
  return element;
};
const put = (element, words) => { if (element.textContent !== words) element.textContent = words; };

/** Fills `container`; `show(state)` takes `state.fault`. */
export function createBreakIt(container) {
  const buttons = add(container, "div", "fault-buttons"), card = add(container, "section", "fault-card");
  buttons.setAttribute("role", "group");
  buttons.setAttribute("aria-label", "Faults");
  card.setAttribute("aria-live", "polite");
  const title = add(card, "h2", "", "Choose a fault"), said = add(card, "p", "", "It shows what stops the machine, why, and how soon.");
  const what = add(card, "p"), advice = add(card, "p", "advice"), tiles = add(card, "dl", "tiles");
  const tile = (words) => { const box = add(tiles, "div"); add(box, "dt", "", words); return add(box, "dd", "", "–"); };
  const after = tile("reaction after"), before = tile("tip moved until then"), way = tile("tip moved after it");
  const note = add(card, "p", "note");
  tiles.hidden = true;
  let may = false, injecting = false, list = [];

  async function recall() {
    const answer = await fetch("api/faults").catch(() => null);
    if (!answer?.ok) { // a page may be opened before the run is up
      put(note, answer ? await answer.text() : "The console does not answer.");
      setTimeout(() => { recalled = false; }, AGAIN_MS);
      return;
    }
    put(note, "");
    list = (await answer.json()).map((fault) => {
      const button = add(buttons, "button", "", fault.title);
      button.type = "button";
      button.title = fault.why_not || fault.what;
      button.addEventListener("click", () => inject(fault));
      return { button, fault };
    });
    enable();
  }

  function enable() {
    for (const { button, fault } of list) button.disabled = !may || injecting || Boolean(fault.why_not);
  }

  async function inject(fault) {
    injecting = true;
    enable();
    put(note, "");
    put(title, fault.title);
    put(said, "Is being injected …");
    for (const element of [what, advice]) put(element, "");
    tiles.hidden = true;
    try {
      const answer = await post(`api/faults/${fault.name}`, { signal: AbortSignal.timeout(8000) });
      if (!answer.ok) failed((await answer.text()) || answer.statusText);
    } catch (error) {
      failed(`The fault could not be injected (${error.message}).`);
    } finally {
      injecting = false;
      enable();
    }
  }

  function failed(why) {
    put(said, "It was not injected.");
    put(note, why);
  }

  function show(state) {
    if (state.lease.mine !== may) { may = state.lease.mine; enable(); }
    if (!list.length && !recalled) { recalled = true; recall(); }
    const fault = state.fault;
    if (!fault || injecting) return;
    const stop = fault.stop;
    card.classList.toggle("stopped", Boolean(stop));
    put(title, fault.title);
    put(said, stop ? `${stop.mode}: ${stop.code}` : outcome(fault));
    put(what, stop?.text ?? "");
    put(advice, stop ? `What to do: ${stop.advice}` : "");
    tiles.hidden = !stop;
    put(after, stop ? `${fault.ms.toFixed(0)} ms` : "–");
    put(before, millimetres(fault.before_mm));
    put(way, millimetres(fault.after_mm));
    if (stop) put(note, fault.done ? "Ways are those of the hanger pin by the joints' encoders; a fault of an encoder falsifies them." : "The tip is still followed.");
  }

  let recalled = false;
  return { show };
}

function outcome(fault) {
  if (fault.stood) return `The machine stood already (${fault.begun_in}).`;
  return fault.done ? `It did not stop the machine (${fault.begun_in} when it began).` : "Injected. Waiting for the machine's reaction …";
}

function millimetres(value) {
  return value === null ? "unknown" : `${value.toFixed(value < 10 ? 1 : 0)} mm`;
}
