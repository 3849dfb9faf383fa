// This page's token, which every command and the websocket carry.  It stays with the tab from page to page.

const KEY = "timberhand-page";
let told = { token: "", page: 0, person: "", role: "viewer", signs_in: false };

/** Ask for the token; goes to the sign-in page where that comes first.  A recording gives none, and needs none. */
export async function beginAccess() {
  try {
    const answer = await fetch("api/session", { method: "POST", headers: header(sessionStorage.getItem(KEY) ?? "") });
    if (answer.status === 401) location.replace("sign-in");
    if (!answer.ok) return told;
    told = await answer.json();
    sessionStorage.setItem(KEY, told.token);
  } catch { /* no connection: the websocket tries again, and asks anew */ }
  return told;
}

/** Whether this page has a token now: a console that was started anew takes it away. */
export const hasToken = () => Boolean(told.token);

/** A POST with the token; `options` as for fetch. */
export function post(path, options = {}) {
  return fetch(path, { method: "POST", ...options, headers: { ...header(told.token), ...options.headers } });
}

/** The address of the websocket. */
export function socketAddress() {
  const url = new URL("ws", location.href);
  url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  if (told.token) url.searchParams.set("page", told.token);
  return url;
}

function header(token) {
  return token ? { "X-Timberhand-Page": token } : {};
}
