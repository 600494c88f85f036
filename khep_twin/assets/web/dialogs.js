// Dialogs of the page.

import { post } from "./api.js";
import { attempt, banner } from "./banners.js";
import { $, create, createTable } from "./page.js";

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

export function ask(title, body, ok = "OK") {
  const dialog = $("#dialog");
  dialog.querySelector("h2").textContent = title;
  dialog.querySelector(".body").replaceChildren(body);
  dialog.querySelector("button.main").textContent = ok;
  dialog.querySelector("[value=cancel]").hidden = ok === "Close";
  dialog.returnValue = "";
  dialog.showModal();
  body.querySelector?.("select, input")?.focus();
  if (body.matches?.("select, input")) body.focus();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue === "ok"), { once: true }));
}

export async function chooseFile() {
  const { files } = await post("list");
  if (!files.length) return banner("There are no playpens below this folder yet."), null;
  const list = create("select", { size: 12 }, ...files.map((name) => new Option(name, name)));
  list.selectedIndex = 0;
  list.addEventListener("dblclick", () => $("#dialog").close("ok"));
  return (await ask("Open", list)) ? list.value : null;
}

const thumbnails = new Map();

// Asks for a playpen of the library, by its picture and a line of description.
export async function chooseFromLibrary(library) {
  const cards = create("div", { className: "cards" });
  for (const [name, description] of Object.entries(library)) {
    const choice = create("input", { type: "radio", name: "library", value: name, checked: !cards.childElementCount });
    const picture = create("img", { alt: "", src: thumbnails.get(name) ?? "static/icon.svg" });
    const card = create("label", {}, choice, picture, create("strong", {}, name), create("span", {}, description));
    card.addEventListener("dblclick", () => $("#dialog").close("ok"));
    cards.append(card);
  }
  const answer = ask("New from the library", cards);
  // One at a time: the server draws each at its first request.
  attempt(async () => {
    for (const [index, name] of Object.keys(library).entries()) {
      if (!thumbnails.has(name)) thumbnails.set(name, URL.createObjectURL(await post("thumbnail", { name })));
      cards.children[index].querySelector("img").src = thumbnails.get(name);
      if (!cards.isConnected || !$("#dialog").open) return;
    }
  }, "thumbnails");
  return (await answer) ? cards.querySelector(":checked").value : null;
}

export async function showPreview(draft) {
  const closeBanner = banner("The scene is being compiled and drawn.");
  const blob = await post("preview", { draft }).finally(closeBanner);
  const picture = create("img", { src: URL.createObjectURL(blob), alt: "The compiled scene in perspective" });
  await ask("The compiled scene", picture, "Close");
  URL.revokeObjectURL(picture.src);
}

export async function showKeys() {
  await ask("Keys", createTable(KEYS), "Close");
}
