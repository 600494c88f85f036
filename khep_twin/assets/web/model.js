// The drawn playpen: a draft with the keys of its file, the selection, and the history.
//
// A part is an entry of one of the draft's tables; its id is the table and the index, such as "block:0".

// Kinds of objects on the floor: their keys besides name, x and y, with default values.
export const OBJECTS = {
  block: { angle_deg: 0, length_mm: 60, width_mm: 20, height_mm: 50, surface: "white", movable: false, mass_g: 20, ramp: false },
  cylinder: { radius_mm: 12.5, height_mm: 50, surface: "white", movable: false, mass_g: 20 },
};

export const KINDS = ["patch", "wall", ...Object.keys(OBJECTS), "spot", "lamp", "robot"];

export const DEFAULTS = {
  ...OBJECTS,
  wall: { closed: false, thickness_mm: 10, height_mm: 50, surface: "white" },
  patch: { radius_mm: 40, surface: "black" },
  lamp: { z_mm: 15, power_w: 7, dim: 1, rgb: [255, 217, 77], blink_period_s: 0, blink_duty: 0.5, fade_s: 0, flicker: 0 },
  robot: { heading_deg: 90, model: "khepera1", calibration: "khepera1", mode: 1, rom: "5.02" },
  spot: { heading_deg: 90 },
};

const SECTIONS = ["arena", "lighting"];

export class Model extends EventTarget {
  draft = { arena: { width_mm: 600, height_mm: 500 } };
  document = { file: null, version: null, base: {}, savedText: "" };
  openCount = 0; // documents that were opened, or to which undo or redo has returned
  selected = new Set();
  problems = [];
  #undoStates = []; // former drafts as JSON, each with its document
  #redoStates = [];
  #text = ""; // draft as JSON

  // Opens a document; undo returns to the previous one, unless that was an unchanged new playpen.
  load(reply, base = {}) {
    const previous = this.document;
    if (this.openCount > 1 || this.file || this.isChanged) this.#pushUndo();
    this.document = { file: reply.file ?? null, version: reply.version ?? null, base };
    this.selected.clear();
    this.#setDraft(reply.draft);
    this.#text = this.document.savedText = JSON.stringify(this.draft);
    this.#notify("draft");
    this.#notifyDocument(previous, false);
  }

  get file() {
    return this.document.file;
  }

  get isChanged() {
    return this.openCount > 0 && this.#text !== this.document.savedText;
  }

  partsOf(kind) {
    return this.draft[kind] ?? [];
  }

  part(id) {
    const [kind, index] = id.split(":");
    return this.partsOf(kind)[+index];
  }

  ids() {
    return KINDS.flatMap((kind) => this.partsOf(kind).map((_, index) => `${kind}:${index}`));
  }

  select(ids) {
    this.selected = new Set(ids);
    this.#notify("selection");
  }

  // Completes a change of the draft: undo returns to the draft before it.
  commit() {
    const text = JSON.stringify(this.draft);
    if (text !== this.#text) {
      this.#pushUndo();
      this.#text = text;
    }
    this.#notify("draft");
  }

  // Replaces the draft; undo restores the previous one.
  replace(draft) {
    this.#setDraft(draft);
    this.commit();
  }

  undo() {
    this.#restore(this.#undoStates, this.#redoStates);
  }

  redo() {
    this.#restore(this.#redoStates, this.#undoStates);
  }

  get canUndo() {
    return this.#undoStates.length > 0;
  }

  get canRedo() {
    return this.#redoStates.length > 0;
  }

  // Reports parts that were moved by a drag, which commit() completes.
  notifyMoved(ids) {
    this.dispatchEvent(new CustomEvent("moved", { detail: ids }));
  }

  add(kind, part) {
    const completePart = { ...structuredClone(DEFAULTS[kind]), ...part };
    if (kind === "spot") completePart.name = this.#findName("spot");
    (this.draft[kind] ??= []).push(completePart);
    this.selected = new Set([`${kind}:${this.partsOf(kind).length - 1}`]);
    this.commit();
  }

  copy() {
    const copies = [];
    for (const id of this.selected) {
      const kind = id.split(":")[0];
      const part = structuredClone(this.part(id));
      if (kind === "spot") part.name = this.#findName("spot");
      else delete part.name;
      shift(part, 20, -20);
      this.draft[kind].push(part);
      copies.push(`${kind}:${this.partsOf(kind).length - 1}`);
    }
    this.selected = new Set(copies);
    this.commit();
  }

  remove() {
    for (const kind of KINDS)
      if (this.draft[kind]) this.draft[kind] = this.draft[kind].filter((_, index) => !this.selected.has(`${kind}:${index}`));
    this.selected.clear();
    this.commit();
  }

  #pushUndo() {
    this.#undoStates.push({ text: this.#text, document: this.document });
    if (this.#undoStates.length > 300) this.#undoStates.shift();
    this.#redoStates = [];
  }

  #findName(stem) {
    const usedNames = new Set(this.ids().map((id) => this.part(id).name));
    let number = 1;
    while (usedNames.has(`${stem}${number}`)) number++;
    return `${stem}${number}`;
  }

  #restore(from, to) {
    if (!from.length) return;
    to.push({ text: this.#text, document: this.document });
    const previous = this.document;
    const { text, document } = from.pop();
    Object.assign(this, { document });
    if (document !== previous) this.selected.clear();
    this.#text = text;
    this.#setDraft(JSON.parse(text));
    this.#notify("draft");
    if (document !== previous) this.#notifyDocument(previous, true);
  }

  // Reports that another document is open, one of the history or a new one.
  #notifyDocument(previous, isHistory) {
    this.openCount++;
    this.dispatchEvent(new CustomEvent("document", { detail: { previous, isHistory } }));
  }

  // Sets the draft, with all sections that the panels have fields for.
  #setDraft(draft) {
    this.draft = draft;
    for (const section of SECTIONS) draft[section] ??= {};
    this.selected = new Set([...this.selected].filter((id) => this.part(id)));
  }

  #notify(subject) {
    this.dispatchEvent(new CustomEvent("change", { detail: subject }));
  }
}

export function shift(part, dx, dy) {
  if (part.points_mm) part.points_mm = part.points_mm.map(([x, y]) => [roundHundredths(x + dx), roundHundredths(y + dy)]);
  else {
    part.x_mm = roundHundredths(clampFinite(part.x_mm) + dx);
    part.y_mm = roundHundredths(clampFinite(part.y_mm) + dy);
  }
}

export function rotate(part, degrees) {
  const key = "heading_deg" in part ? "heading_deg" : "angle_deg";
  if (key in part || "length_mm" in part) part[key] = wrapAngle((part[key] ?? 0) + degrees);
}

export const wrapAngle = (degrees) => {
  const positive = ((degrees % 360) + 360) % 360;
  return roundHundredths(positive > 180 ? positive - 360 : positive);
};

// Returns a number that can be drawn for a value that is being typed, which may be no number yet or a huge one.
export const clampFinite = (value, fallback = 0) => (Number.isFinite(value) ? Math.min(Math.max(value, -1e5), 1e5) : fallback);
export const roundHundredths = (value) => Math.round(value * 100) / 100;

// Returns true for the keys of undo, false for those of redo, and null for other keys.
export function readUndoKey({ key, ctrlKey, metaKey, shiftKey }) {
  const letter = key.toLowerCase();
  if (!(ctrlKey || metaKey) || (letter !== "z" && letter !== "y")) return null;
  return letter === "z" && !shiftKey;
}
