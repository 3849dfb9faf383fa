// The browser's part of the watch: it answers the state, so that the controller knows that a person is connected.
// It keeps this page's control lease, too.
// An answer to a message comes from a hidden tab as well, where timers are slowed down.

import { post } from "./access.js";

const PERIOD_MS = 180; // of states every 50 ms each fourth is answered

/** `answer(socket, state)` after each state; closing the page ends the watch, a vanished browser does not. */
export function createHeartbeat() {
  let page = newName(), answeredAt = -Infinity, closed = false, last = null;
  window.addEventListener("pagehide", () => {
    closed = true;
    if (answeredAt > 0) post(`api/watch-end/${page}`, { keepalive: true }).catch(() => {});
    last?.close(); // at once: the page that comes next in this tab takes its token over
  });
  // A page that the browser kept and shows again is a new one.
  window.addEventListener("pageshow", () => { if (closed) [page, closed] = [newName(), false]; });
  return {
    answer(socket, state) {
      const now = performance.now();
      last = socket;
      if (closed || !(state.may_command || state.lease?.mine) || now - answeredAt < PERIOD_MS) return;
      answeredAt = now;
      socket.send(`${page} ${state.sent_ms}`);
    },
  };
}

function newName() {
  return Array.from(crypto.getRandomValues(new Uint32Array(2)), (part) => part.toString(36)).join("-");
}
