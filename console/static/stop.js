// The STOP button and its keys, for pages with nothing else to stop: Escape anywhere, Space outside of a text field.

/** `failed(text)` tells that STOP did not arrive; `before()` closes what is open. */
export function createStop(button, failed, before = () => {}) {
  const typing = (event) => event.target instanceof Element && event.target.closest("input, textarea, select");

  // Without a token, a sign-in or a queue: STOP needs nothing.
  async function stop() {
    try {
      const answer = await fetch("api/operator/stop", { method: "POST", signal: AbortSignal.timeout(2000) });
      if (!answer.ok) throw new Error((await answer.text()) || answer.statusText);
    } catch (error) { failed(`STOP could not be sent (${error.message}). Press the hard-wired emergency stop.`); }
  }

  button.addEventListener("click", stop);
  window.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" && (event.key !== " " || typing(event))) return;
    event.preventDefault();
    event.stopPropagation();
    before();
    if (!event.repeat) stop();
  }, { capture: true });
  // Releasing the space bar clicks a focused button; here it only means STOP.
  window.addEventListener("keyup", (event) => {
    if (event.key === " " && !typing(event)) event.preventDefault();
  }, { capture: true });
}
