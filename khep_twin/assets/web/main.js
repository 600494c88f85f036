// The page: files, banners, dialogs, keys, and what brings the parts together.

import { listen, post, tab, upload } from "./api.js";
import { Drawing } from "./drawing.js";
import { Editor } from "./editor.js";
import { Fields } from "./fields.js";
import { Model } from "./model.js";
import { Running } from "./run.js";

const $ = (selector) => document.querySelector(selector);
const model = new Model();
const drawing = new Drawing($("#view"), model);
const running = new Running(drawing, model, banner);
const snap = () => ({ grid: +$("#grid").value, angle: +$("#angle").value });
let hello;
let gone = null;
let say = () => {};

const editor = new Editor(drawing, model, {
  snap,
  running,
  told(tool, at) {
    for (const button of document.querySelectorAll("#tools button")) button.setAttribute("aria-pressed", button.dataset.tool === tool);
    if (at) $("#place").textContent = `${at[0].toFixed(0)}, ${at[1].toFixed(0)} mm`;
  },
});

// Banners ------------------------------------------------------------------------------------------------

// One that is about the same takes the place of the last.
function banner(text, kind = "", choices = {}, about = text) {
  const same = [...$("#banners").children].find((each) => each.dataset.about === about);
  same?.remove();
  const box = document.createElement("div");
  box.className = `banner ${kind}`;
  box.dataset.about = about;
  box.append(Object.assign(document.createElement("span"), { textContent: text }));
  const close = () => box.remove();
  for (const [name, act] of Object.entries(choices)) {
    const button = Object.assign(document.createElement("button"), { textContent: name });
    button.addEventListener("click", () => {
      close();
      attempt(act);
    });
    box.append(button);
  }
  const away = Object.assign(document.createElement("button"), { textContent: "×", title: "Close" });
  away.addEventListener("click", close);
  box.append(away);
  $("#banners").append(box);
  while ($("#banners").children.length > 3) $("#banners").firstChild.remove();
  if (!Object.keys(choices).length) setTimeout(close, kind === "error" ? 15000 : 8000);
  return close;
}

async function attempt(act) {
  try {
    return await act();
  } catch (error) {
    banner(error.message, "error");
    return undefined;
  }
}

function ask(title, body, ok = "OK") {
  const dialog = $("#dialog");
  dialog.querySelector("h2").textContent = title;
  dialog.querySelector(".body").replaceChildren(body);
  dialog.querySelector("button.main").textContent = ok;
  dialog.querySelector("[value=cancel]").hidden = ok === "Close";
  dialog.returnValue = "";
  dialog.showModal();
  body.querySelector?.("select, input")?.focus();
  if (body.matches?.("select, input")) body.focus();
  return new Promise((done) => dialog.addEventListener("close", () => done(dialog.returnValue === "ok"), { once: true }));
}

// Files --------------------------------------------------------------------------------------------------

async function choose(title, names, empty) {
  const list = document.createElement("select");
  list.size = 12;
  list.append(...names.map((name) => new Option(name, name)));
  list.selectedIndex = 0;
  list.addEventListener("dblclick", () => $("#dialog").close("ok"));
  if (!names.length) return banner(empty), null;
  return (await ask(title, list)) ? list.value : null;
}

// What is not saved stays as a draft, and can be had back by undo of nothing: ask before it goes.
async function mayLeave() {
  const text = Object.assign(document.createElement("p"), { textContent: "There are changes that are not saved." });
  if (model.changed && !(await ask("Leave this playpen?", text, "Discard them"))) return false;
  if (running.active && !running.real) await post("end");
  return true;
}

function show(found, base) {
  model.load(found, base);
  remember();
  drawing.fit();
  say({ file: model.file, tab, ask: true });
}

// So that the page, loaded anew, has the same file again.
function remember() {
  history.replaceState(null, "", model.file ? `#${encodeURIComponent(model.file)}` : location.pathname);
}

async function openFile(name) {
  if (!name || !(await mayLeave())) return;
  const found = await post("open", { file: name });
  await post("keep", { file: model.file, draft: null });
  const left = name === model.file ? null : found.left;
  show(found, { file: name });
  offer(left);
}

function offer(left) {
  if (!left || JSON.stringify(left) === JSON.stringify(model.draft)) return;
  banner("There is a draft of this playpen that was never saved.", "", {
    "Go on with it": () => {
      model.draft = left;
      model.commit();
    },
    "Throw it away": () => post("keep", { file: model.file, draft: null }),
  });
}

async function save(name = model.file, overwrite = false) {
  if (!name) return saveAs();
  const draft = structuredClone(model.draft);
  try {
    const version = name === model.file ? model.version : null;
    const found = await post("save", { file: name, draft, version, base: model.base, overwrite });
    const before = model.file;
    Object.assign(model, { file: name, version: found.version, base: { file: name }, saved: JSON.stringify(draft) });
    if (before !== name) await post("keep", { file: before, draft: null });
    title();
    remember();
    banner(`Saved as ${name}.`, "", {}, "file");
  } catch (error) {
    if (!error.conflict) throw error;
    banner(error.message, "error", {
      "Load it anew": () => post("open", { file: name }).then((found) => show(found, { file: name })),
      "Save under another name": saveAs,
      "Replace it": () => save(name, true),
    }, "file");
  }
}

async function saveAs() {
  const input = Object.assign(document.createElement("input"), { value: model.file ?? `${model.draft.name}.toml` });
  input.setAttribute("aria-label", "Name of the file");
  if (!(await ask("Save as", input, "Save"))) return;
  const name = input.value.trim().replace(/(\.toml)?$/, ".toml");
  const stem = name.replace(/^.*\//, "").slice(0, -5);
  if (name !== model.file && /^[A-Za-z0-9_-]{1,64}$/.test(stem) && stem !== model.draft.name) {
    model.draft.name = stem;
    model.commit();
  }
  await save(name);
}

async function take(file) {
  if (!file || !(await mayLeave())) return;
  const input = Object.assign(document.createElement("input"), { type: "number", value: 1, step: "any", min: 0.01 });
  const label = document.createElement("label");
  label.append("How many mm is a pixel of it? ", input);
  if (!(await ask(`Import ${file.name}`, label, "Import"))) return;
  show(await upload(file, input.value), {});
  model.saved = "";
  title();
}

async function preview() {
  const made = banner("The scene is being compiled and drawn.");
  const blob = await post("preview", { draft: model.draft }).finally(made);
  const picture = Object.assign(document.createElement("img"), { src: URL.createObjectURL(blob), alt: "The compiled scene in perspective" });
  await ask("The compiled scene", picture, "Close");
  URL.revokeObjectURL(picture.src);
}

function title() {
  $("#file").textContent = `${model.file ?? "new playpen"}${model.changed ? " *" : ""}`;
  document.title = `${$("#file").textContent} – Khepera designer`;
}

// Checks and drafts --------------------------------------------------------------------------------------

let checking = false;
let again = false;

async function check() {
  again = true;
  if (checking) return;
  checking = true;
  while (again) {
    again = false;
    await new Promise((done) => setTimeout(done, 50));
    const found = await attempt(() => post("check", { draft: model.draft }));
    if (found) problems(found.problems);
  }
  checking = false;
}

function problems(found) {
  model.problems = found;
  drawing.marks();
  const list = $("#problems");
  list.classList.toggle("none", !found.length);
  if (!found.length) {
    list.textContent = `No problems: this playpen can be saved${model.list("robot").length ? " and run." : "; with a robot it can be run."}`;
    return;
  }
  list.replaceChildren(
    ...found.map(({ place, text }) => {
      const button = Object.assign(document.createElement("button"), { textContent: text });
      const id = `${place[0]}:${place[1]}`;
      button.addEventListener("click", () => drawing.nodes.has(id) && model.select([id]));
      return button;
    }),
  );
}

let keeping;

function keepSoon() {
  clearTimeout(keeping);
  keeping = setTimeout(() => keepNow(), 800);
}

function keepNow(more = {}) {
  clearTimeout(keeping);
  keeping = undefined;
  if (model.changed) attempt(() => post("keep", { file: model.file, draft: model.draft }, more));
}

function legend() {
  const used = new Set([model.draft.arena.surface ?? "white", ...["block", "cylinder", "wall", "patch"].flatMap((kind) => model.list(kind).map((thing) => thing.surface ?? "white"))]);
  const entries = [...used].map((name) => {
    const box = document.createElement("i");
    box.style.background = drawing.colour(name);
    return [box, name];
  });
  const counts = ["block", "cylinder", "wall", "lamp", "robot"].map((kind) => [kind, model.list(kind).length]).filter(([, count]) => count);
  const live = Object.assign(document.createElement("div"), { className: "live-only" });
  live.append(...[["seen", "what a sensor sees"], ["way", "the way so far"]].flatMap(([name, text]) => [Object.assign(document.createElement("i"), { className: name }), text]));
  $("#legend").replaceChildren(...entries.flat(), ` · ${counts.map(([kind, count]) => `${count} ${kind}${count > 1 ? "s" : ""}, `).join("")}dotted: movable, dashed with !: wrong`, live);
}

model.addEventListener("change", ({ detail }) => {
  $("#undo").disabled = !model.canUndo;
  $("#redo").disabled = !model.canRedo;
  $("#copy").disabled = $("#delete").disabled = !model.selected.size;
  title();
  if (detail !== "whole") return;
  legend();
  check();
  keepSoon();
});
model.addEventListener("moved", () => check());

// Keys, buttons, drops -----------------------------------------------------------------------------------

const KEYS = [
  ["V B C W L R P S", "select, block, cylinder, wall, lamp, robot, patch, spot"],
  ["Enter", "puts the tool's object into the middle; ends a wall"],
  ["Tab, Shift+Tab", "from object to object"],
  ["arrows", "move by the grid, with Shift ten times, with Alt 1 mm; with nothing selected, the view"],
  ["[ ]", "turn by the angle, with Alt 1°"],
  ["Delete, right button", "take away"],
  ["Ctrl+D, Ctrl+A, Ctrl+Z, Ctrl+Y, Ctrl+S", "copy, select all, undo, redo, save"],
  ["Shift+click, drag on the floor", "select several"],
  ["Alt while dragging", "without grid"],
  ["two fingers", "zoom, move the view, turn a lifted robot"],
  ["wheel, + − 0", "zoom; middle button or Ctrl+drag moves the view"],
  ["Space . Esc", "while it runs: pause, step, stop; the wheel turns a lifted robot"],
];

async function help() {
  const table = document.createElement("table");
  for (const [keys, what] of KEYS) {
    const row = document.createElement("tr");
    row.append(Object.assign(document.createElement("th"), { textContent: keys }), Object.assign(document.createElement("td"), { textContent: what }));
    table.append(row);
  }
  await ask("Keys", table, "Close");
}

function press(id, act) {
  $(`#${id}`).addEventListener("click", () => attempt(act));
}

const drawn = (act) => () => (running.active && !running.real ? banner("A twin runs in this drawing; right is to end it first.") : act());
press("new", async () => {
  const name = await choose("New from the library", hello.library);
  if (name && (await mayLeave())) {
    await post("keep", { file: model.file, draft: null });
    show(await post("library", { name }), { library: name });
  }
});
press("open", async () => openFile(await choose("Open", (await post("list")).files, "There are no playpens below this folder yet.")));
press("save", () => save());
press("save-as", saveAs);
press("undo", drawn(() => model.undo()));
press("redo", drawn(() => model.redo()));
press("copy", drawn(() => model.copy()));
press("delete", drawn(() => model.remove()));
press("zoom-in", () => drawing.zoom(0.8));
press("zoom-out", () => drawing.zoom(1.25));
press("zoom-fit", () => drawing.fit());
press("preview", preview);
press("help", help);
$("#figure").addEventListener("click", () => {
  const picture = Object.assign(document.createElement("img"), { src: $("#figure").src, alt: $("#figure").alt });
  attempt(() => ask("Sensor test", picture, "Close"));
});
for (const button of document.querySelectorAll("#tools button")) button.addEventListener("click", () => editor.use(button.dataset.tool));
for (const button of document.querySelectorAll("[role=tab]"))
  button.addEventListener("click", () => {
    for (const each of document.querySelectorAll("[role=tab]")) {
      each.setAttribute("aria-selected", each === button);
      $(`#tab-${each.dataset.tab}`).hidden = each !== button;
    }
    if (button.dataset.tab === "run") attempt(programs);
  });
$("#import").addEventListener("change", (event) => {
  attempt(() => take(event.target.files[0]));
  event.target.value = "";
});
$("#arena").addEventListener("dragover", (event) => event.preventDefault());
$("#arena").addEventListener("drop", (event) => {
  event.preventDefault();
  attempt(() => take(event.dataTransfer.files[0]));
});
document.addEventListener("keydown", (event) => {
  if ($("#dialog").open) return;
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "s") {
    event.preventDefault();
    return void attempt(() => save());
  }
  // Stopping comes first, wherever the keys go.
  if (event.key === "Escape" && running.active) return void running.key(event);
  if (event.target.matches("input, select, textarea") || (event.target.matches("button") && [" ", "Enter"].includes(event.key))) return;
  if (event.key === "?") return void help();
  if (running.key(event) || editor.key(event)) event.preventDefault();
});
addEventListener("pagehide", () => keepNow({ keepalive: true }));
addEventListener("beforeunload", (event) => {
  // Nobody keeps a draft any more.
  if (gone && model.changed) event.preventDefault();
});
document.addEventListener("visibilitychange", () => document.hidden && keepNow({ keepalive: true }));

async function programs() {
  const found = await post("list");
  const chosen = $("#controller").value;
  $("#controller").replaceChildren(...[...hello.controllers, ...found.programs].map((name) => new Option(name, name)));
  if (chosen) $("#controller").value = chosen;
  $("#ports").replaceChildren(...found.ports.map(({ url, what }) => new Option(what, url)));
}

// Other pages --------------------------------------------------------------------------------------------

function hear(message) {
  if (message.kind === "saved" && message.tab !== tab && message.file === model.file && message.version !== model.version)
    banner(`${message.file} was saved by another page.`, "error", {
      "Load it anew": () => post("open", { file: message.file }).then((found) => show(found, { file: message.file })),
      "Keep mine": () => {},
    }, "file");
  else if (message.kind === "page") {
    const other = JSON.parse(message.said);
    if (other.tab === tab || other.file !== model.file) return;
    banner(`Another page has ${model.file ?? "a new playpen"} open, too: who saves second is asked first.`, "", {}, "file");
    if (other.ask) say({ file: model.file, tab });
  } else running.hear(message);
}

hello = await post("hello");
drawing.surfaces = hello.surfaces;
drawing.shapes = hello.shapes;
running.panel.limits(hello.bars, $("#bars"));
new Fields(model, hello.surfaces);
const last = await attempt(() => decodeURIComponent(location.hash.slice(1)));
const found = (last && last !== hello.file && (await attempt(() => post("open", { file: last })))) || hello;
show(found, found.version ? { file: found.file } : {});
if (hello.trouble) banner(hello.trouble, "error");
if (hello.runs) {
  // What a twin runs in is shown as it is, saved or not.
  model.draft = hello.runs;
  model.commit();
  drawing.fit();
  $('[data-tab="run"]').click();
} else offer(found.left);
await attempt(programs);
say = listen(hear, (lost) => {
  if (lost) gone ??= banner("The designer does not answer: it was ended, or is busy. What you draw from now on stays in this page only.", "error", { "All right": () => {} });
  else {
    gone?.();
    gone = null;
    say({ file: model.file, tab, ask: true });
  }
});
document.documentElement.dataset.ready = "yes";
