// Signing in; STOP works before it.

import { createStop } from "./stop.js";

const $ = (id) => document.getElementById(id);

createStop($("stop"), (text) => { $("alarm").textContent = text; $("alarm").hidden = false; });

$("form").addEventListener("submit", async (event) => {
  event.preventDefault();
  $("enter").disabled = true;
  $("note").textContent = "";
  try {
    const body = JSON.stringify({ name: $("name").value, password: $("password").value });
    const answer = await fetch("api/sign-in", { method: "POST", body });
    if (!answer.ok) throw new Error(await answer.text());
    location.replace("./");
  } catch (error) {
    $("note").textContent = error.message;
    $("password").value = "";
    $("password").focus();
  }
  $("enter").disabled = false;
});
$("name").focus();
