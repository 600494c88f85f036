// Requests and messages between the page and its server.

const base = location.pathname.replace(/[^/]*$/, "");
export const tab = crypto.getRandomValues(new Uint32Array(2)).join("-");

const QUIET = { "Khepera-Quiet": "yes" }; // a refusal is no error of the page, which its console would show

const KEEPALIVE_LIMIT = 60_000; // browsers refuse more than 64 KiB of a request that outlives its page [bytes]

// Requests about a running twin: each waits for the previous one, as requests may overtake each other.
const ORDERED = ["pace", "step", "put", "switch"];
let lastOrdered = Promise.resolve();

// Requests an action with values; returns the reply. `options` are those of fetch.
export function post(action, values = {}, options = {}) {
  const send = () => sendRequest(action, values, options);
  if (!ORDERED.includes(action)) return send();
  return (lastOrdered = lastOrdered.then(send, send));
}

export async function upload(file, mm) {
  const query = new URLSearchParams({ name: file.name.replace(/[^\w.-]/g, "-"), mm });
  const response = await fetchFromDesigner(`${base}import?${query}`, {
    method: "POST",
    headers: { "Content-Type": "application/octet-stream", ...QUIET },
    body: file,
  });
  return readReply(response);
}

// Lets the browser save a file.
export function download(blob, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

// Receives messages; returns a function that sends one. Calls onConnection(true, hasEnded) when the connection is lost,
// with `hasEnded` if the designer reported its end, and onConnection(false) when it is open.
export function listen(onMessage, onConnection) {
  let socket;
  const reconnect = () => setTimeout(open, 1500);
  const open = () => {
    socket = new WebSocket(`ws://${location.host}${base}live`);
    socket.onmessage = (event) => onMessage(JSON.parse(event.data));
    socket.onopen = () => onConnection(false);
    socket.onclose = ({ code }) => {
      onConnection(true, code === 1012);
      reconnect();
    };
  };
  // A request that fails reports the loss before the socket does.
  closeSocket = () => {
    if (!socket.onclose || socket.readyState !== WebSocket.OPEN) return; // a failed attempt to connect calls onclose
    socket.onclose = null;
    socket.close();
    onConnection(true, false);
    reconnect();
  };
  open();
  return (message) => socket.readyState === WebSocket.OPEN && socket.send(JSON.stringify(message));
}

let closeSocket = () => {};

async function sendRequest(action, values, options) {
  const body = JSON.stringify({ ...values, tab });
  const keepalive = options.keepalive === true && new Blob([body]).size < KEEPALIVE_LIMIT;
  const response = await fetchFromDesigner(`${base}do/${action}`, {
    method: "POST",
    headers: { "Content-Type": "application/json", ...QUIET },
    body,
    ...options,
    keepalive,
  });
  return readReply(response);
}

function fetchFromDesigner(url, options) {
  return fetch(url, options).catch(() => {
    closeSocket();
    throw Object.assign(new Error("The designer cannot be reached."), { isUnreachable: true });
  });
}

async function readReply(response) {
  if (["image/png", "application/octet-stream"].includes(response.headers.get("content-type"))) return response.blob();
  const text = await response.text();
  let reply;
  try {
    reply = JSON.parse(text);
  } catch {
    reply = { error: text };
  }
  if (!response.ok || reply.error !== undefined) throw Object.assign(new Error(reply.error), { conflict: reply.conflict === true });
  return reply;
}
