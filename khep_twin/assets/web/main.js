// The page: banners, dialogs, buttons, keys, and the connections between its parts.

import { listen, post, tab } from "./api.js";
import { attempt, banner, settle } from "./banners.js";
import { Challenges } from "./challenges.js";
import { ask, chooseFile, chooseFromLibrary, showKeys, showPreview } from "./dialogs.js";
import { Drafts } from "./drafts.js";
import { Drawing, readStripes } from "./drawing.js";
import { Editor } from "./editor.js";
import { Fields } from "./fields.js";
import { KINDS, Model, OBJECTS } from "./model.js";
import { $, create } from "./page.js";
import { Program } from "./program.js";
import { Running } from "./run.js";
import { Stage } from "./stage.js";

const model = new Model();
const drawing = new Drawing($("#view"), model);
const running = new Running(drawing, model, banner, attempt);
const program = new Program(running, banner, attempt);
const drafts = new Drafts({ model, running, attempt, banner, settle, ask, send: (message) => send(message) });
const challenges = new Challenges({ attempt, program, openFromLibrary: (name) => drafts.openFromLibrary(name) });
const stage = new Stage(model, running, attempt, () => showPreview(model.draft));
const editor = new Editor(drawing, model, {
  readSnap: () => ({ grid: +$("#grid").value, angle: +$("#angle").value }),
  running,
  onTool(tool, position) {
    for (const button of document.querySelectorAll("#tools button")) {
      button.setAttribute("aria-pressed", button.dataset.tool === tool);
      button.classList.toggle("locked", button.dataset.tool === tool && editor.isLocked);
    }
    if (position) $("#place").textContent = `${position[0].toFixed(0)}, ${position[1].toFixed(0)} mm`;
  },
});
let hello; // reply to the first request
let send = () => {}; // sends a message to the other pages
let isOffline = false;
let offlineReason = "";

// Changes of the drawing ---------------------------------------------------------------------------------

let isChecking = false;
let isCheckDue = false;

async function check() {
  isCheckDue = true;
  if (isChecking) return;
  isChecking = true;
  while (isCheckDue) {
    isCheckDue = false;
    await new Promise((resolve) => setTimeout(resolve, 50));
    const reply = await attempt(() => post("check", { draft: model.draft }), "check");
    if (reply) showProblems(reply.problems);
  }
  isChecking = false;
}

function showProblems(problems) {
  model.problems = problems;
  drawing.markParts();
  const list = $("#problems");
  list.classList.toggle("none", !problems.length);
  if (!problems.length) {
    list.textContent = `No problems: this playpen can be saved${model.partsOf("robot").length ? " and run." : "; with a robot it can be run."}`;
    return;
  }
  list.replaceChildren(
    ...problems.map(({ place, text }) => {
      const id = `${place[0]}:${place[1]}`;
      const button = create("button", {}, text);
      button.addEventListener("click", () => drawing.nodes.has(id) && model.select([id]));
      return button;
    }),
  );
}

const PLURALS = { patch: "patches" };

function showLegend() {
  const painted = [model.draft.arena, ...[...Object.keys(OBJECTS), "wall", "patch"].flatMap((kind) => model.partsOf(kind))];
  const surfaces = new Set(painted.flatMap((part) => [part.surface ?? "white", ...readStripes(part).map(([, name]) => name)]));
  const entries = [...surfaces].map((name) => {
    const box = create("i");
    box.style.background = drawing.surfaceColour(name);
    return [box, name];
  });
  const counts = KINDS.map((kind) => [kind, model.partsOf(kind).length]).filter(([, count]) => count);
  const liveEntries = create("div", { className: "live-only" }, create("i", { className: "fov" }), "field of view", create("i", { className: "path" }), "path so far");
  $("#legend").replaceChildren(...entries.flat(), ` · ${counts.map(([kind, count]) => `${count} ${count === 1 ? kind : PLURALS[kind] ?? `${kind}s`}, `).join("")}dotted: movable, dashed with !: wrong`, liveEntries);
}

// While a twin runs, undo is about what was done to it manually.
const currentHistory = () => (running.hasTwin ? running.handling.history : model);

function updateUndoButtons() {
  $("#undo").disabled = !currentHistory().canUndo;
  $("#redo").disabled = !currentHistory().canRedo;
}

running.handling.history.addEventListener("change", updateUndoButtons);
model.addEventListener("document", () => drawing.fit());
model.addEventListener("change", ({ detail }) => {
  updateUndoButtons();
  $("#copy").disabled = $("#delete").disabled = !model.selected.size;
  drafts.showTitle();
  if (detail !== "draft") return;
  showLegend();
  if (!running.isActive) settle("run");
  check();
  drafts.storeSoon();
});
model.addEventListener("moved", () => check());

// Keys, buttons, drops -----------------------------------------------------------------------------------

const FILES = ["new", "open", "save", "save-as"];

function press(id, act) {
  $(`#${id}`).addEventListener("click", () => attempt(act, FILES.includes(id) ? "file" : id));
}

const withoutTwin = (act) => () => (running.hasTwin ? banner("A twin runs in this drawing: end it first.") : act());
press("new", async () => {
  const name = await chooseFromLibrary(hello.library);
  if (name) await drafts.openFromLibrary(name);
});
press("open", async () => drafts.open(await chooseFile()));
press("save", () => drafts.save());
press("save-as", () => drafts.saveAs());
press("undo", () => currentHistory().undo());
press("redo", () => currentHistory().redo());
press("copy", withoutTwin(() => model.copy()));
press("delete", withoutTwin(() => model.remove()));
press("zoom-in", () => stage.zoom("+") || drawing.zoom(0.8));
press("zoom-out", () => stage.zoom("-") || drawing.zoom(1.25));
press("zoom-fit", () => stage.zoom("0") || drawing.fit());
press("help", showKeys);
// A button that only requests an action has the action's name in data-post.
for (const button of document.querySelectorAll("[data-post]")) button.addEventListener("click", () => attempt(() => post(button.dataset.post), button.dataset.about ?? button.id));
$("#figure").addEventListener("click", () => ask("Sensor test", create("img", { src: $("#figure").src, alt: $("#figure").alt }), "Close"));
for (const button of document.querySelectorAll("#tools button")) {
  const { tool } = button.dataset;
  button.addEventListener("click", () => editor.toggleTool(tool));
  if (tool === "select") continue;
  button.title += "; twice, or a double click: kept for several objects";
  button.addEventListener("dblclick", () => editor.selectTool(tool, true));
}
for (const button of document.querySelectorAll("[role=tab]"))
  button.addEventListener("click", () => {
    for (const other of document.querySelectorAll("[role=tab]")) {
      other.setAttribute("aria-selected", other === button);
      $(`#tab-${other.dataset.tab}`).hidden = other !== button;
    }
    if (["run", "challenge"].includes(button.dataset.tab)) attempt(updatePrograms, "programs");
    if (button.dataset.tab === "challenge") attempt(() => challenges.load(), "challenge");
  });
$("#import").addEventListener("change", (event) => {
  attempt(() => drafts.importFile(event.target.files[0]), "file");
  event.target.value = "";
});
$("#arena").addEventListener("dragover", (event) => event.preventDefault());
$("#arena").addEventListener("drop", (event) => {
  event.preventDefault();
  if (isOffline) showOffline();
  else attempt(() => drafts.importFile(event.dataTransfer.files[0]), "file");
});
document.addEventListener("keydown", (event) => {
  if ($("#dialog").open) return;
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "s") {
    event.preventDefault();
    return void (isOffline ? showOffline() : attempt(() => drafts.save(), "file"));
  }
  // Escape stops a run, whatever has the focus.
  if (event.key === "Escape" && running.isActive) return void running.handleKey(event);
  if (event.target.matches("input, select, textarea") || (event.target.matches("button") && [" ", "Enter"].includes(event.key))) return;
  if (event.key === "?") return void showKeys();
  if (running.handleKey(event) || stage.handleKey(event) || editor.handleKey(event)) event.preventDefault();
});
// The browser's undo would continue in other fields, without the drawing.
document.addEventListener("beforeinput", (event) => {
  if (event.inputType.startsWith("history") && (event.target !== document.activeElement || event.target.closest("#tab-object, #tab-playpen"))) event.preventDefault();
});
// A program may fail when its file is read.
document.addEventListener("failed", ({ detail }) => detail.about === "run" && program.markErrorLine(detail.text));
addEventListener("pagehide", () => drafts.store({ keepalive: true }));
addEventListener("beforeunload", (event) => {
  // Without the designer, no draft is stored; programs have no drafts.
  if ((isOffline && model.isChanged) || program.hasChanges) event.preventDefault();
});
document.addEventListener("visibilitychange", () => document.hidden && drafts.store({ keepalive: true }));

// Updates the lists of programs and ports.
async function updatePrograms() {
  const { programs, ports } = await post("list");
  running.driving.setPrograms(programs, updateOptions);
  challenges.setPrograms(programs, updateOptions);
  updateOptions($("#ports"), ports.map(({ url, what }) => new Option(what, url)));
}

// Replaces the options of a list if they differ, as this closes an open list; the chosen one stays.
function updateOptions(list, options) {
  const describe = (option) => `${option.value}\n${option.text}`;
  if ([...list.options].map(describe).join("\n") === options.map(describe).join("\n")) return;
  const { value: chosen } = list;
  list.replaceChildren(...options);
  if (chosen && options.some(({ value }) => value === chosen)) list.value = chosen;
}

// Files that are written while the page is open appear automatically.
setInterval(() => {
  if (hello && !isOffline && !document.hidden && !running.isBusy && (!$("#tab-run").hidden || challenges.isShown)) attempt(updatePrograms, "programs");
}, 3000);

// Messages -----------------------------------------------------------------------------------------------

const messageHandlers = { ...running.messageHandlers, ...challenges.messageHandlers, ...drafts.messageHandlers };

function handleMessage(message) {
  if (message.tab && message.tab !== tab) return; // a reply to another page
  messageHandlers[message.kind](message);
}

// Disables everything that needs the designer when it is lost, and enables it when it is back.
function handleConnection(isLost, hasEnded) {
  if (!isLost) drafts.announce(true);
  if (isLost === isOffline) return;
  isOffline = isLost;
  for (const element of document.querySelectorAll("[data-server]")) element.inert = isOffline;
  if (!isOffline) {
    settle("server");
    check();
    drafts.storeSoon();
    if (challenges.isShown) attempt(() => challenges.load(), "challenge"); // a scoring may have continued
    return;
  }
  const twin = running.hasTwin ? ", and the twin with it" : "";
  offlineReason = hasEnded ? `The designer has ended${twin}. To continue, start it again and use the page that it opens.` : "The designer cannot be reached.";
  handleMessage({ kind: "ended" });
  handleMessage({ kind: "score-ended", text: "" });
  showOffline();
}

function showOffline() {
  banner(`${offlineReason} Nothing can be saved or run from here. What you draw now stays in this page only.`, "error", {}, "server");
}

// Start --------------------------------------------------------------------------------------------------

async function start() {
  const name = decodeHash();
  try {
    hello = await post("hello", name === "" ? {} : { file: name === "new" ? null : name });
  } catch (error) {
    banner(`The designer cannot start: ${error.message}`, "error", { "Try again": () => location.reload() });
    return;
  }
  drawing.surfaces = hello.surfaces;
  drawing.shapes = hello.shapes;
  drawing.turrets = hello.turrets;
  running.curves.setColours(hello.colours);
  new Fields(model, hello);
  model.load(hello, hello.version ? { file: hello.file } : {});
  if (hello.trouble) banner(hello.trouble, "error", {}, "file");
  if (hello.runs && hello.runs.file === hello.file) {
    // A twin's playpen is shown as it is, saved or not.
    if (JSON.stringify(hello.runs.draft) !== JSON.stringify(model.draft)) model.document.version = hello.runs.version; // so that Save asks if the file has changed since
    model.replace(hello.runs.draft);
    drawing.fit();
    $('[data-tab="run"]').click();
  }
  drafts.offer(hello.left);
  await attempt(updatePrograms, "programs");
  send = listen(handleMessage, handleConnection);
  document.documentElement.dataset.ready = "yes";
}

// Returns the file of a page that is loaded again, "new" for a new playpen.
function decodeHash() {
  try {
    return decodeURIComponent(location.hash.slice(1));
  } catch {
    return "";
  }
}

start();
