// The playpen that is drawn: a draft in the keys of its file, the selection, and the history.

// What stands on the floor: its keys besides name, x and y, with their values in a new one.
export const OBJECTS = {
  block: { angle_deg: 0, length_mm: 60, width_mm: 20, height_mm: 50, surface: "white", movable: false, mass_g: 20, ramp: false },
  cylinder: { radius_mm: 12.5, height_mm: 50, surface: "white", movable: false, mass_g: 20 },
};

export const KINDS = ["patch", "wall", ...Object.keys(OBJECTS), "spot", "lamp", "robot"];

export const NEW = {
  ...OBJECTS,
  wall: { closed: false, thickness_mm: 10, height_mm: 50, surface: "white" },
  patch: { radius_mm: 40, surface: "black" },
  lamp: { z_mm: 15, power_w: 7, dim: 1, rgb: [255, 217, 77], blink_period_s: 0, blink_duty: 0.5, fade_s: 0, flicker: 0 },
  robot: { heading_deg: 90, model: "khepera1", calibration: "khepera1", mode: 1, rom: "5.02" },
  spot: { heading_deg: 90 },
};

const PARTS = ["arena", "lighting"];

export class Model extends EventTarget {
  draft = { arena: { width_mm: 600, height_mm: 500 } };
  document = { file: null, version: null, base: {}, saved: "" };
  opened = 0; // counts the documents that this page has opened or gone back to
  selected = new Set();
  problems = [];
  #before = []; // states, each with the document that it is of
  #after = [];
  #now = "";

  // Opens a document; undo goes back to the former one, unless that was an untouched new playpen.
  load(found, base = {}) {
    const left = this.document;
    if (this.opened > 1 || this.file || this.changed) this.#keep();
    this.document = { file: found.file ?? null, version: found.version ?? null, base };
    this.selected.clear();
    this.#take(found.draft);
    this.#now = this.document.saved = JSON.stringify(this.draft);
    this.#tell("whole");
    this.#arrive(left, false);
  }

  get file() {
    return this.document.file;
  }

  get changed() {
    return this.opened > 0 && this.#now !== this.document.saved;
  }

  list(kind) {
    return this.draft[kind] ?? [];
  }

  at(id) {
    const [kind, index] = id.split(":");
    return this.list(kind)[+index];
  }

  ids() {
    return KINDS.flatMap((kind) => this.list(kind).map((_, index) => `${kind}:${index}`));
  }

  select(ids) {
    this.selected = new Set(ids);
    this.#tell("selection");
  }

  // After a change: keeps the previous state for undo.
  commit() {
    const now = JSON.stringify(this.draft);
    if (now !== this.#now) {
      this.#keep();
      this.#now = now;
    }
    this.#tell("whole");
  }

  #keep() {
    this.#before.push({ text: this.#now, document: this.document });
    if (this.#before.length > 300) this.#before.shift();
    this.#after = [];
  }

  // Takes another drawing in place of this one; undo brings it back.
  replace(draft) {
    this.#take(draft);
    this.commit();
  }

  undo() {
    this.#swap(this.#before, this.#after);
  }

  redo() {
    this.#swap(this.#after, this.#before);
  }

  get canUndo() {
    return this.#before.length > 0;
  }

  get canRedo() {
    return this.#after.length > 0;
  }

  // During a drag: only these have moved.
  moved(ids) {
    this.dispatchEvent(new CustomEvent("moved", { detail: ids }));
  }

  add(kind, thing) {
    const whole = { ...structuredClone(NEW[kind]), ...thing };
    if (kind === "spot") whole.name = this.#name("spot");
    (this.draft[kind] ??= []).push(whole);
    this.selected = new Set([`${kind}:${this.list(kind).length - 1}`]);
    this.commit();
  }

  copy() {
    const made = [];
    for (const id of this.selected) {
      const kind = id.split(":")[0];
      const thing = structuredClone(this.at(id));
      if (kind === "spot") thing.name = this.#name("spot");
      else delete thing.name;
      shift(thing, 20, -20);
      this.draft[kind].push(thing);
      made.push(`${kind}:${this.list(kind).length - 1}`);
    }
    this.selected = new Set(made);
    this.commit();
  }

  remove() {
    for (const kind of KINDS)
      if (this.draft[kind]) this.draft[kind] = this.draft[kind].filter((_, index) => !this.selected.has(`${kind}:${index}`));
    this.selected.clear();
    this.commit();
  }

  #name(stem) {
    const taken = new Set(this.ids().map((id) => this.at(id).name));
    let number = 1;
    while (taken.has(`${stem}${number}`)) number++;
    return `${stem}${number}`;
  }

  #swap(from, to) {
    if (!from.length) return;
    to.push({ text: this.#now, document: this.document });
    const left = this.document;
    const { text, document } = from.pop();
    Object.assign(this, { document });
    if (document !== left) this.selected.clear();
    this.#now = text;
    this.#take(JSON.parse(text));
    this.#tell("whole");
    if (document !== left) this.#arrive(left, true);
  }

  // Tells that another document is open now, a new one or one of the history.
  #arrive(left, back) {
    this.opened++;
    this.dispatchEvent(new CustomEvent("document", { detail: { left, back } }));
  }

  // The panels have fields for parts that a draft need not have.
  #take(draft) {
    this.draft = draft;
    for (const part of PARTS) draft[part] ??= {};
    this.selected = new Set([...this.selected].filter((id) => this.at(id)));
  }

  #tell(what) {
    this.dispatchEvent(new CustomEvent("change", { detail: what }));
  }
}

export function shift(thing, dx, dy) {
  if (thing.points_mm) thing.points_mm = thing.points_mm.map(([x, y]) => [tidy(x + dx), tidy(y + dy)]);
  else {
    thing.x_mm = tidy(drawable(thing.x_mm) + dx);
    thing.y_mm = tidy(drawable(thing.y_mm) + dy);
  }
}

export function turn(thing, degrees) {
  const key = "heading_deg" in thing ? "heading_deg" : "angle_deg";
  if (key in thing || "length_mm" in thing) thing[key] = angle((thing[key] ?? 0) + degrees);
}

export const angle = (degrees) => {
  const turned = ((degrees % 360) + 360) % 360;
  return tidy(turned > 180 ? turned - 360 : turned);
};
// A typed value may be no number yet, or a huge one: returns the value to draw meanwhile.
export const drawable = (value, otherwise = 0) => (Number.isFinite(value) ? Math.min(Math.max(value, -1e5), 1e5) : otherwise);
export const tidy = (value) => Math.round(value * 100) / 100;

// Returns true for the keys of undo, false for those of redo, and null for others.
export function undoKey({ key, ctrlKey, metaKey, shiftKey }) {
  const letter = key.toLowerCase();
  if (!(ctrlKey || metaKey) || (letter !== "z" && letter !== "y")) return null;
  return letter === "z" && !shiftKey;
}
