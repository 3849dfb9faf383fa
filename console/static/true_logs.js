// The logs as they truly are, which only a simulated run knows: asked for while the button is pressed.

const PERIOD_MS = 500, PATIENCE = 4, ANSWER_MS = 5000;
const $ = (id) => document.getElementById(id);

/** Connects the button of a run whose plant can be asked; `scene()` is the 3-D view or null, `alarm` shows a sentence. */
export function createTrueLogs(scene, alarm) {
  const button = $("true-logs");
  let timer = 0, missed = 0, busy = false;

  async function ask() {
    if (document.hidden || !scene() || busy) return;
    busy = true;
    try {
      const answer = await fetch("api/true-logs", { signal: AbortSignal.timeout(ANSWER_MS) });
      if (!answer.ok) throw new Error(await answer.text());
      const logs = await answer.json();
      missed = 0;
      if (timer) scene().trueLogs(logs);
    } catch (error) { // a busy plant may miss an answer
      if (++missed < PATIENCE || !timer) return;
      show(false);
      alarm(error.message, 5000);
    } finally { busy = false; }
  }

  function show(so) {
    clearInterval(timer);
    missed = 0;
    timer = so ? setInterval(ask, PERIOD_MS) : 0;
    button.setAttribute("aria-pressed", so);
    $("true-legend").hidden = !so;
    if (so) ask();
    else scene()?.trueLogs([]);
  }

  button.hidden = false;
  button.addEventListener("click", () => show(!timer));
}
