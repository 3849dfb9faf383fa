// Signing in, by name and password or by the token that the console printed; STOP works before it.

import { createStop } from "./stop.js";

const $ = (id) => document.getElementById(id);

createStop($("stop"), (text) => { $("alarm").textContent = text; $("alarm").hidden = false; });

function connect(form, button, note, secret, body) {
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    button.disabled = true;
    note.textContent = "";
    try {
      const answer = await fetch("api/sign-in", { method: "POST", body: JSON.stringify(body()) });
      if (!answer.ok) throw new Error(await answer.text());
      location.replace("./");
    } catch (error) {
      note.textContent = error.message;
      secret.value = "";
      secret.focus();
    }
    button.disabled = false;
  });
}

connect($("form"), $("enter"), $("note"), $("password"), () => ({ name: $("name").value, password: $("password").value }));
connect($("token-form"), $("enter-token"), $("token-note"), $("token"),
  () => ({ token: $("token").value.trim().replace(/^.*[?&]token=/, "") }));

async function start() {
  const { by } = await (await fetch("api/sign-in")).json();
  $(by === "token" ? "token-form" : "form").hidden = false;
  $(by === "token" ? "token" : "name").focus();
}

start().catch((error) => { $("alarm").textContent = `The page could not start: ${error.message}`; $("alarm").hidden = false; });
