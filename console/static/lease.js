// The control lease in the header: who has control, take it, take it over on purpose, give it back; and who is signed in.
// A page without a session only looks, and says how to get one.

import { hasToken, post } from "./access.js";

/** Fills `container`; `alarm(text, ms)` tells what goes wrong; `me` is this page's session; returns `{show(state)}`. */
export function createLease(container, alarm, me) {
  const words = make("span", "lease-words"), button = make("button", ""), enter = signIn(), dialog = makeDialog();
  button.type = "button";
  button.id = "lease-button";
  container.append(words, button, enter);
  container.hidden = false;
  if (me.signs_in) container.append(signOut());
  let lease = null, had = false;

  button.addEventListener("click", () => {
    if (lease.mine) send("give-back");
    else if (!lease.page) send("take", { over: 0 });
    else dialog.ask(lease);
  });

  async function send(what, body = {}) {
    try {
      const answer = await post(`api/lease/${what}`, { body: JSON.stringify(body), signal: AbortSignal.timeout(2000) });
      if (!answer.ok) throw new Error(await answer.text());
    } catch (error) { alarm(`Control has not changed: ${error.message}`, 8000); }
  }

  function show(state) {
    if (!state.lease) { container.hidden = true; return; }
    lease = state.lease;
    if (had && !lease.mine && lease.page) alarm(`${lease.holder} has taken control over.`, 10000);
    had = lease.mine;
    document.body.dataset.control = lease.mine ? "mine" : lease.page ? "other" : "nobody";
    put(words, !hasToken() ? "Looking only" : lease.mine ? "You have control" : lease.page ? `${lease.holder} has control` : "Nobody has control");
    put(button, lease.mine ? "Give back" : lease.page ? "Take over …" : "Take control");
    button.hidden = !lease.may_take;
    enter.hidden = hasToken();
    if (dialog.element.open && (lease.mine || !lease.page)) dialog.element.close();
    if (state.audit) alarm(state.audit, 2000);
  }

  // Not modal: a modal dialog would disable STOP.
  function makeDialog() {
    const element = document.createElement("dialog"), title = make("h2", ""), text = make("p", ""), row = make("div", "commands");
    const no = make("button", "", "Cancel"), yes = make("button", "yes", "Take control over");
    element.id = "take-over";
    title.id = "take-over-title";
    element.setAttribute("aria-labelledby", title.id);
    [no.type, yes.type, no.id, yes.id] = ["button", "button", "take-over-no", "take-over-yes"];
    row.append(no, yes);
    element.append(title, text, row);
    document.body.append(element);
    let over = 0;
    no.addEventListener("click", () => element.close());
    yes.addEventListener("click", () => { element.close(); send("take", { over }); });
    return {
      element,
      ask(from) {
        over = from.page;
        put(title, "Take control over?");
        put(text, `${from.holder} has control and loses it. Speak with that person first, unless nobody is there.`);
        element.show();
        no.focus();
      },
    };
  }

  function signIn() {
    const enter = make("a", "button", "Sign in …");
    enter.id = "sign-in";
    enter.hidden = true;
    enter.href = "sign-in";
    enter.title = "To command, open the address that the console printed at its start";
    return enter;
  }

  function signOut() {
    const leave = make("button", "", `Sign out ${me.person}`);
    leave.type = "button";
    leave.id = "sign-out";
    leave.addEventListener("click", async () => { await post("api/sign-out"); location.replace("sign-in"); });
    return leave;
  }

  return { show };
}

function make(name, className, words = "") {
  const element = document.createElement(name);
  if (className) element.className = className;
  element.textContent = words;
  return element;
}

function put(element, words) {
  if (element.textContent !== words) element.textContent = words;
}
