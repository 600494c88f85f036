// Requests and messages between the page and its server.

const base = location.pathname.replace(/[^/]*$/, "");
export const tab = crypto.getRandomValues(new Uint32Array(2)).join("-");

const QUIET = { "Khepera-Quiet": "yes" }; // a refusal is no error of the page, which its console would show

const KEPT_ALIVE = 60_000; // browsers refuse more than 64 KiB of a request that outlives its page [bytes]

// Actions about the time of a twin and what is in it: each waits for the one before, as requests may overtake each other.
const ORDERED = ["pace", "step", "put", "switch"];
let before = Promise.resolve();

export function post(action, wanted = {}, more = {}) {
  const ask = () => request(action, wanted, more);
  if (!ORDERED.includes(action)) return ask();
  return (before = before.then(ask, ask));
}

async function request(action, wanted, more) {
  const body = JSON.stringify({ ...wanted, tab });
  const keepalive = more.keepalive === true && new Blob([body]).size < KEPT_ALIVE;
  const answer = await reach(`${base}do/${action}`, {
    method: "POST",
    headers: { "Content-Type": "application/json", ...QUIET },
    body,
    ...more,
    keepalive,
  });
  return read(answer);
}

export async function upload(file, mm) {
  const query = new URLSearchParams({ name: file.name.replace(/[^\w.-]/g, "-"), mm });
  const answer = await reach(`${base}import?${query}`, {
    method: "POST",
    headers: { "Content-Type": "application/octet-stream", ...QUIET },
    body: file,
  });
  return read(answer);
}

let drop = () => {};

function reach(url, wanted) {
  return fetch(url, wanted).catch(() => {
    drop();
    throw Object.assign(new Error("The designer cannot be reached."), { unreached: true });
  });
}

async function read(answer) {
  if (["image/png", "application/octet-stream"].includes(answer.headers.get("content-type"))) return answer.blob();
  const text = await answer.text();
  let found;
  try {
    found = JSON.parse(text);
  } catch {
    found = { error: text };
  }
  if (!answer.ok || found.error !== undefined) throw Object.assign(new Error(found.error), { conflict: found.conflict === true });
  return found;
}

// Has the browser keep a file.
export function keep(blob, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

// Receives messages; calls lost(true, ended) when the connection is lost, with `ended` if the designer reported its
// end, and lost(false) when it is back.
export function listen(hear, lost) {
  let socket;
  const again = () => setTimeout(open, 1500);
  const open = () => {
    socket = new WebSocket(`ws://${location.host}${base}live`);
    socket.onmessage = (event) => hear(JSON.parse(event.data));
    socket.onopen = () => lost(false);
    socket.onclose = ({ code }) => {
      lost(true, code === 1012);
      again();
    };
  };
  // A request that fails reports this before the socket does.
  drop = () => {
    if (!socket.onclose || socket.readyState !== WebSocket.OPEN) return; // an attempt to connect reports by itself
    socket.onclose = null;
    socket.close();
    lost(true, false);
    again();
  };
  open();
  return (message) => socket.readyState === WebSocket.OPEN && socket.send(JSON.stringify(message));
}
