// The page: files, banners, dialogs, keys, and the connections between the parts.

import { Challenges } from "./challenges.js";
import { listen, post, tab, upload } from "./api.js";
import { Drawing, pattern } from "./drawing.js";
import { Editor } from "./editor.js";
import { Fields } from "./fields.js";
import { KINDS, Model, OBJECTS } from "./model.js";
import { Program } from "./program.js";
import { Running } from "./run.js";
import { Stage } from "./stage.js";

const $ = (selector) => document.querySelector(selector);
const model = new Model();
const drawing = new Drawing($("#view"), model);
const running = new Running(drawing, model, banner, attempt);
const program = new Program(running, banner, attempt);
const challenges = new Challenges({ attempt, program, open: openFromLibrary });
const stage = new Stage(model, running, attempt, preview);
const snap = () => ({ grid: +$("#grid").value, angle: +$("#angle").value });
let hello;
let gone = false;
let offered = null;
let why = "";
let say = () => {};

const editor = new Editor(drawing, model, {
  snap,
  running,
  told(tool, at) {
    for (const button of document.querySelectorAll("#tools button")) {
      button.setAttribute("aria-pressed", button.dataset.tool === tool);
      button.classList.toggle("kept", button.dataset.tool === tool && editor.kept);
    }
    if (at) $("#place").textContent = `${at[0].toFixed(0)}, ${at[1].toFixed(0)} mm`;
  },
});

// Banners ------------------------------------------------------------------------------------------------

// A banner replaces the last one about the same subject. An error stays until its action has succeeded.
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
      attempt(act, about);
    });
    box.append(button);
  }
  const away = Object.assign(document.createElement("button"), { textContent: "×", title: "Close" });
  away.addEventListener("click", close);
  box.append(away);
  $("#banners").append(box);
  // Banners that offer a choice are not removed.
  if ($("#banners").children.length > 4) [...$("#banners").children].find((each) => each.childElementCount === 2)?.remove();
  if (!Object.keys(choices).length && (kind !== "error" || about === "hand")) setTimeout(close, 8000);
  return close;
}

function settle(about) {
  for (const each of errors(about)) each.remove();
}

function errors(about) {
  return [...document.querySelectorAll(".banner.error")].filter((each) => each.dataset.about === about);
}

async function attempt(act, about) {
  // Banners shown meanwhile, such as of a twin that does not start, stay.
  const before = errors(about);
  try {
    const found = await act();
    for (const each of before) each.remove();
    return found;
  } catch (error) {
    // The loss of the designer is reported once, elsewhere.
    if (!error.unreached) banner(error.message, "error", {}, about);
    if (about === "run") program.mark(error.message); // a file may fail when it is read
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

const thumbnails = new Map();

// Asks for a playpen of the library, by its picture and a line of description.
async function chooseFromLibrary() {
  const cards = document.createElement("div");
  cards.className = "cards";
  for (const [name, line] of Object.entries(hello.library)) {
    const card = document.createElement("label");
    const choice = Object.assign(document.createElement("input"), { type: "radio", name: "library", value: name, checked: !cards.childElementCount });
    const [title, told] = [document.createElement("strong"), document.createElement("span")];
    title.textContent = name;
    told.textContent = line;
    card.append(choice, Object.assign(document.createElement("img"), { alt: "", src: thumbnails.get(name) ?? "static/icon.svg" }), title, told);
    card.addEventListener("dblclick", () => $("#dialog").close("ok"));
    cards.append(card);
  }
  const chosen = ask("New from the library", cards);
  // One at a time: the server draws each when it is first asked for.
  attempt(async () => {
    for (const [index, name] of Object.keys(hello.library).entries()) {
      if (!thumbnails.has(name)) thumbnails.set(name, URL.createObjectURL(await post("thumbnail", { name })));
      cards.children[index].querySelector("img").src = thumbnails.get(name);
      if (!cards.isConnected || !$("#dialog").open) return;
    }
  }, "thumbnails");
  return (await chosen) ? cards.querySelector(":checked").value : null;
}

async function openFromLibrary(name) {
  if (await mayLeave()) await leaveFor(await post("library", { name }), { library: name });
}

// Changes that are not saved are discarded with their draft: ask before.
async function mayLeave() {
  const text = Object.assign(document.createElement("p"), { textContent: "There are changes that are not saved. Undo brings them back, while this page is open." });
  if (model.changed && !(await ask("Leave this playpen?", text, "Discard them"))) return false;
  await endTwin();
  return true;
}

// Ends the twin that runs in the drawing, before another document is opened.
async function endTwin() {
  if (running.active && !running.real) await post("end");
}

// Another document is open, a new one or one that undo or redo has gone back to.
model.addEventListener("document", ({ detail: { left, back } }) => {
  // These banners are about the document that was open.
  for (const each of [...$("#banners").children]) if (["file", "draft", "conflict", "others"].includes(each.dataset.about)) each.remove();
  const had = hasDraft;
  hasDraft = false;
  remember();
  drawing.fit();
  say({ file: model.file, tab, ask: true });
  if (!back) return;
  if (had) attempt(() => forget(left.file), "keep"); // it is in the history, as its draft was
  banner(`${model.file ?? "A new playpen"} is open again.`, "", {}, "file");
});

// Opens a document instead of the one whose changes the user has discarded, and offers its drafts.
function leaveFor(found, base) {
  const before = model.file;
  model.load(found, base);
  offer(found.left ?? []);
  return forget(before);
}

// Deletes this page's own draft of a document; those of others stay.
function forget(file) {
  return post("keep", { file, draft: null });
}

// The hash makes a reloaded page open the same document; every file ends in .toml.
function remember() {
  history.replaceState(null, "", model.file ? `#${encodeURIComponent(model.file)}` : "#new");
}

async function openFile(name) {
  if (name && (await mayLeave())) await loadAnew(name);
}

async function loadAnew(name) {
  await endTwin();
  await leaveFor(await post("open", { file: name }), { file: name });
}

// Offers the newest of the drafts that other pages have left of this document, then the next.
function offer(left) {
  const [kept, ...others] = left.filter((each) => each.page !== tab && JSON.stringify(each.draft) !== JSON.stringify(model.draft));
  if (!kept) return;
  const { file, opened } = model;
  const when = new Date(kept.time * 1000).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
  const close = banner(`A draft of ${file ?? "a new playpen"} was never saved (${when}).`, "", {
    "Continue it": async () => {
      if (running.active && !running.real) {
        offer(left);
        throw new Error("A twin runs in this drawing: end it first.");
      }
      // Its page may have written it again when it was closed.
      const now = (await post("left", { file })).left.find(({ page }) => page === kept.page) ?? kept;
      if (model.opened !== opened) return;
      // With the version that it was made from, so that Save asks if the file has changed since.
      Object.assign(model.document, { version: now.version === undefined ? model.document.version : now.version, base: now.base ?? model.document.base });
      model.replace(now.draft);
      if (await keepNow()) await post("keep", { file, draft: null, page: kept.page });
    },
    "Discard it": async () => {
      await post("keep", { file, draft: null, page: kept.page });
      if (model.opened === opened) offer(others);
    },
  }, "draft");
  offered = { page: kept.page, close };
}

let saving = Promise.resolve();

// One save at a time: each starts from the version that the one before has written.
function save(name = model.file, overwrite = false, rename = false) {
  if (!name) return saveAs();
  const { opened } = model;
  const saved = saving.then(() => model.opened === opened && write(name, overwrite, rename));
  saving = saved.catch(() => {});
  return saved;
}

async function write(name, overwrite, rename) {
  const draft = structuredClone(model.draft);
  const { file: before, opened } = model;
  try {
    const version = name === before ? model.document.version : null;
    const found = await post("save", { file: name, draft, version, base: model.document.base, overwrite, rename });
    if (before !== name) await forget(before);
    if (model.opened !== opened) return;
    hasDraft = false;
    if (rename) draft.name = model.draft.name = found.name;
    model.commit();
    Object.assign(model.document, { file: name, version: found.version, base: { file: name }, saved: JSON.stringify(draft) });
    title();
    remember();
    if (model.changed) keepSoon();
    settle("conflict");
    banner(`Saved as ${name}.`, "", {}, "file");
  } catch (error) {
    if (!error.conflict || model.opened !== opened) throw error;
    banner(error.message, "error", {
      "Load it again": () => loadAnew(name),
      "Save under another name": saveAs,
      "Replace it": () => save(name, true, rename),
    }, "conflict");
  }
}

async function saveAs() {
  const input = Object.assign(document.createElement("input"), { value: model.file ?? `${model.draft.name}.toml` });
  input.setAttribute("aria-label", "Name of the file");
  if (!(await ask("Save as", input, "Save"))) return;
  const name = input.value.trim().replace(/(\.toml)?$/, ".toml");
  // A file under another name renames the playpen.
  await save(name, false, name !== model.file);
}

async function take(file) {
  if (!file || !(await mayLeave())) return;
  const input = Object.assign(document.createElement("input"), { type: "number", value: 1, step: "any", min: 0.01 });
  const label = document.createElement("label");
  label.append("Size of a pixel in mm: ", input);
  if (!(await ask(`Import ${file.name}`, label, "Import"))) return;
  const leaving = leaveFor(await upload(file, input.value), {});
  model.document.saved = "";
  title();
  await leaving;
}

async function preview() {
  const made = banner("The scene is being compiled and drawn.");
  const blob = await post("preview", { draft: model.draft }).finally(made);
  const picture = Object.assign(document.createElement("img"), { src: URL.createObjectURL(blob), alt: "The compiled scene in perspective" });
  await ask("The compiled scene", picture, "Close");
  URL.revokeObjectURL(picture.src);
}

function title() {
  $("#file").textContent = $("#file").title = `${model.file ?? "new playpen"}${model.changed ? " *" : ""}`;
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
    const found = await attempt(() => post("check", { draft: model.draft }), "check");
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
let hasDraft = false;

function keepSoon() {
  clearTimeout(keeping);
  keeping = setTimeout(() => keepNow(), 800);
}

function keepNow(more = {}) {
  clearTimeout(keeping);
  keeping = undefined;
  const { draft, changed, document: { file, version, base } } = model;
  // Changes that were undone leave no draft.
  if (!changed && !hasDraft) return undefined;
  hasDraft = changed;
  return attempt(() => post("keep", { file, version, base, draft: changed ? draft : null }, more), "keep");
}

const PLURALS = { patch: "patches" };

function legend() {
  const painted = [model.draft.arena, ...[...Object.keys(OBJECTS), "wall", "patch"].flatMap((kind) => model.list(kind))];
  const used = new Set(painted.flatMap((thing) => [thing.surface ?? "white", ...pattern(thing).map(([, name]) => name)]));
  const entries = [...used].map((name) => {
    const box = document.createElement("i");
    box.style.background = drawing.colour(name);
    return [box, name];
  });
  const counts = KINDS.map((kind) => [kind, model.list(kind).length]).filter(([, count]) => count);
  const live = Object.assign(document.createElement("div"), { className: "live-only" });
  live.append(...[["seen", "field of view"], ["way", "path so far"]].flatMap(([name, text]) => [Object.assign(document.createElement("i"), { className: name }), text]));
  $("#legend").replaceChildren(...entries.flat(), ` · ${counts.map(([kind, count]) => `${count} ${count === 1 ? kind : PLURALS[kind] ?? `${kind}s`}, `).join("")}dotted: movable, dashed with !: wrong`, live);
}

// While a twin runs, undo is about what was done to it by hand.
const undoable = () => (running.twin ? running.handling.hands : model);

function undoButtons() {
  $("#undo").disabled = !undoable().canUndo;
  $("#redo").disabled = !undoable().canRedo;
}

running.handling.hands.addEventListener("change", undoButtons);
model.addEventListener("change", ({ detail }) => {
  undoButtons();
  $("#copy").disabled = $("#delete").disabled = !model.selected.size;
  title();
  if (detail !== "whole") return;
  legend();
  if (!running.active) settle("run");
  check();
  keepSoon();
});
model.addEventListener("moved", () => check());

// Keys, buttons, drops -----------------------------------------------------------------------------------

const KEYS = [
  ["V B C W L R P S", "select, block, cylinder, wall, lamp, robot, patch, spot; twice, or a double click on the tool: kept for several objects"],
  ["Enter", "put the tool's object into the middle; end a wall"],
  ["Tab, Shift+Tab", "go to the next or previous object"],
  ["arrows", "move by the grid, with Shift ten times, with Alt 1 mm; with nothing selected, move the view"],
  ["[ ]", "turn by the angle, with Alt 1°"],
  ["Delete, right button", "remove"],
  ["Ctrl+D, Ctrl+A, Ctrl+Z, Ctrl+Y, Ctrl+S", "copy, select all, undo, redo, save; during a run, undo and redo are about lifted robots and switched lamps"],
  ["Shift+click, drag on the floor", "select several"],
  ["Alt while dragging", "ignore the grid"],
  ["two fingers", "zoom, move the view, turn a lifted robot"],
  ["wheel, + − 0", "zoom; middle button or Ctrl+drag moves the view"],
  ["3, F", "plan or 3-D; in 3-D, follow the robot: drag, or the arrows, to orbit, with Shift or the right button to move"],
  ["Space . Esc", "during a run: pause, step, stop; the wheel turns a lifted robot"],
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

const FILES = ["new", "open", "save", "save-as"];

function press(id, act) {
  $(`#${id}`).addEventListener("click", () => attempt(act, FILES.includes(id) ? "file" : id));
}

const drawn = (act) => () => (running.active && !running.real ? banner("A twin runs in this drawing: end it first.") : act());
press("new", async () => {
  const name = await chooseFromLibrary();
  if (name) await openFromLibrary(name);
});
press("open", async () => openFile(await choose("Open", (await post("list")).files, "There are no playpens below this folder yet.")));
press("save", () => save());
press("save-as", saveAs);
press("undo", () => undoable().undo());
press("redo", () => undoable().redo());
press("copy", drawn(() => model.copy()));
press("delete", drawn(() => model.remove()));
press("zoom-in", () => stage.zoom("+") || drawing.zoom(0.8));
press("zoom-out", () => stage.zoom("-") || drawing.zoom(1.25));
press("zoom-fit", () => stage.zoom("0") || drawing.fit());
press("help", help);
// A button that only asks the designer for an action needs no more than this name of it.
for (const button of document.querySelectorAll("[data-post]")) button.addEventListener("click", () => attempt(() => post(button.dataset.post), button.dataset.about ?? button.id));
$("#figure").addEventListener("click", () => {
  const picture = Object.assign(document.createElement("img"), { src: $("#figure").src, alt: $("#figure").alt });
  ask("Sensor test", picture, "Close");
});
for (const button of document.querySelectorAll("#tools button")) {
  const { tool } = button.dataset;
  button.addEventListener("click", () => editor.take(tool));
  if (tool === "select") continue;
  button.title += "; twice, or a double click: kept for several objects";
  button.addEventListener("dblclick", () => editor.use(tool, true));
}
for (const button of document.querySelectorAll("[role=tab]"))
  button.addEventListener("click", () => {
    for (const each of document.querySelectorAll("[role=tab]")) {
      each.setAttribute("aria-selected", each === button);
      $(`#tab-${each.dataset.tab}`).hidden = each !== button;
    }
    if (["run", "challenge"].includes(button.dataset.tab)) attempt(programs, "programs");
    if (button.dataset.tab === "challenge") attempt(() => challenges.show(), "challenge");
  });
$("#import").addEventListener("change", (event) => {
  attempt(() => take(event.target.files[0]), "file");
  event.target.value = "";
});
$("#arena").addEventListener("dragover", (event) => event.preventDefault());
$("#arena").addEventListener("drop", (event) => {
  event.preventDefault();
  if (gone) tellGone();
  else attempt(() => take(event.dataTransfer.files[0]), "file");
});
document.addEventListener("keydown", (event) => {
  if ($("#dialog").open) return;
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "s") {
    event.preventDefault();
    return void (gone ? tellGone() : attempt(() => save(), "file"));
  }
  // Stopping comes first, wherever the keys go.
  if (event.key === "Escape" && running.active) return void running.key(event);
  if (event.target.matches("input, select, textarea") || (event.target.matches("button") && [" ", "Enter"].includes(event.key))) return;
  if (event.key === "?") return void help();
  if (running.key(event) || stage.key(event) || editor.key(event)) event.preventDefault();
});
// The browser's own undo would go on to other fields, of which the drawing knows nothing.
document.addEventListener("beforeinput", (event) => {
  if (event.inputType.startsWith("history") && (event.target !== document.activeElement || event.target.closest("#tab-object, #tab-playpen"))) event.preventDefault();
});
addEventListener("pagehide", () => keepNow({ keepalive: true }));
addEventListener("beforeunload", (event) => {
  // No draft is kept any more, and none of programs.
  if ((gone && model.changed) || program.changed) event.preventDefault();
});
document.addEventListener("visibilitychange", () => document.hidden && keepNow({ keepalive: true }));

async function programs() {
  const found = await post("list");
  running.driving.offer([...hello.controllers, ...found.programs], renew);
  challenges.programs(found.programs, renew);
  renew($("#ports"), found.ports.map(({ url, what }) => new Option(what, url)));
}

// Replaces a list where it has changed, as an open one closes; what was chosen stays.
function renew(list, options) {
  const told = (each) => `${each.value}\n${each.text}`;
  if ([...list.options].map(told).join("\n") === options.map(told).join("\n")) return;
  const chosen = list.value;
  list.replaceChildren(...options);
  if (chosen && options.some(({ value }) => value === chosen)) list.value = chosen;
}

// A file that is written while the page is open appears by itself.
setInterval(() => {
  if (hello && !gone && !document.hidden && !running.busy && (!$("#tab-run").hidden || challenges.shown)) attempt(programs, "programs");
}, 3000);

function decodedHash() {
  try {
    return decodeURIComponent(location.hash.slice(1));
  } catch {
    return "";
  }
}

// Other pages --------------------------------------------------------------------------------------------

// What the page does about each kind of message (khep_twin/web/messages.py).
const hears = {
  ...running.hears,
  ...challenges.hears,
  saved({ by, file, version }) {
    if (by === tab || file !== model.file || version === model.document.version) return;
    banner(`${file} was saved by another page.`, "error", {
      "Load it anew": () => loadAnew(file),
      "Keep mine": () => {},
    }, "conflict");
  },
  page({ said }) {
    const other = JSON.parse(said);
    if (other.tab === tab || other.file !== model.file) return;
    // The other page still uses a draft that was considered abandoned.
    if (other.tab === offered?.page) offered.close();
    banner(`Another page has ${model.file ?? "a new playpen"} open, too: the second page to save must confirm.`, "", {}, "others");
    if (other.ask) say({ file: model.file, tab });
  },
};

function hear(message) {
  if (message.tab && message.tab !== tab) return; // an answer to another page
  hears[message.kind](message);
}

// Without the designer, everything that needs it is disabled.
function lost(away, ended) {
  if (!away) say({ file: model.file, tab, ask: true });
  if (away === gone) return;
  gone = away;
  for (const each of document.querySelectorAll("[data-server]")) each.inert = gone;
  if (!gone) {
    settle("server");
    check();
    keepSoon();
    if (challenges.shown) attempt(() => challenges.show(), "challenge"); // what is being scored goes on
    return;
  }
  const twin = running.active && !running.real ? ", and the twin with it" : "";
  why = ended ? `The designer has ended${twin}. To continue, start it again and use the page that it opens.` : "The designer cannot be reached.";
  hear({ kind: "ended" });
  hear({ kind: "score-ended", text: "" });
  tellGone();
}

function tellGone() {
  banner(`${why} Nothing can be saved or run from here. What you draw now stays in this page only.`, "error", {}, "server");
}

async function begin() {
  const last = decodedHash();
  try {
    hello = await post("hello", last === "" ? {} : { file: last === "new" ? null : last });
  } catch (error) {
    banner(`The designer cannot start: ${error.message}`, "error", { "Try again": () => location.reload() });
    return;
  }
  drawing.surfaces = hello.surfaces;
  drawing.shapes = hello.shapes;
  drawing.turrets = hello.turrets;
  running.panel.limits(hello.bars, $("#bars"));
  running.curves.limits(hello.colours);
  new Fields(model, hello.surfaces, hello.turrets);
  model.load(hello, hello.version ? { file: hello.file } : {});
  if (hello.trouble) banner(hello.trouble, "error", {}, "file");
  if (hello.runs && hello.runs.file === hello.file) {
    // A twin's playpen is shown as it is, saved or not.
    if (JSON.stringify(hello.runs.draft) !== JSON.stringify(model.draft)) model.document.version = hello.runs.version; // so that Save asks if the file has changed since
    model.replace(hello.runs.draft);
    drawing.fit();
    $('[data-tab="run"]').click();
  }
  offer(hello.left);
  await attempt(programs, "programs");
  say = listen(hear, lost);
  document.documentElement.dataset.ready = "yes";
}

begin();
