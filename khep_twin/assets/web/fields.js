// Exact numbers: a field for each key of what is selected, and of the playpen as a whole.

import { OBJECTS, undoKey } from "./model.js";

const CHOICES = {
  model: ["khepera1", "khepera2", "khepera4"],
  rom: ["5.02", "4.06", "khepera2"],
  "lighting.mode": ["all", "random", "sequenced"],
  "lighting.law": ["optics", "toolbox"],
};
const KEYS = {
  ...Object.fromEntries(Object.entries(OBJECTS).map(([kind, keys]) => [kind, ["name", "x_mm", "y_mm", ...Object.keys(keys), "stripes"]])),
  wall: ["name", "points_mm", "closed", "thickness_mm", "height_mm", "surface", "stripes"],
  patch: ["name", "x_mm", "y_mm", "radius_mm", "length_mm", "width_mm", "angle_deg", "surface"],
  lamp: ["name", "x_mm", "y_mm", "z_mm", "power_w", "dim", "rgb", "on_s", "blink_period_s", "blink_duty", "fade_s", "flicker"],
  robot: ["name", "x_mm", "y_mm", "heading_deg", "model", "calibration", "mode", "rom", "turrets", "spots", "battery_used_min"],
  spot: ["name", "x_mm", "y_mm", "heading_deg"],
};
const PARTS = [
  ["arena", ["width_mm", "height_mm", "wall_height_mm", "wall_thickness_mm", "surface", "stripes", "outline_mm", "table"]],
  ["lighting", ["mode", "switch_distance_mm", "law", "min_angle_deg", "max_angle_deg", "mains_hz", "room_lux"]],
];
const TEXTS = new Set(["name", "surface", "model", "calibration", "rom", "mode"]);
const LISTS = new Set(["points_mm", "outline_mm", "rgb", "on_s", "spots", "stripes"]);
const PLACES = new Set(["points_mm", "outline_mm"]);
const EXAMPLES = { spots: 'names, such as "spot1"', stripes: 'widths and surfaces, such as [20, "black"], [20, "white"]' };
const WORDS = { mm: "mm", deg: "°", w: "W", g: "g", s: "s", min: "min" };

export class Fields {
  constructor(model, surfaces, turrets) {
    Object.assign(this, { model, surfaces, turrets });
    this.object = document.querySelector("#tab-object");
    this.playpen = document.querySelector("#tab-playpen");
    this.empty = this.object.innerHTML;
    for (const panel of [this.object, this.playpen]) panel.addEventListener("keydown", (event) => this.#key(event));
    model.addEventListener("change", () => this.show());
    model.addEventListener("moved", () => this.fresh());
  }

  show() {
    // The edited field stays: Tab goes to the field after it.
    if (this.taking) return this.fresh(true);
    const { model } = this;
    const ids = [...model.selected];
    this.bound = [];
    if (!ids.length) this.object.innerHTML = this.empty;
    else {
      const kinds = [...new Set(ids.map((id) => id.split(":")[0]))];
      const things = ids.map((id) => model.at(id));
      const title = document.createElement("h3");
      title.textContent = ids.length === 1 ? `${kinds[0]} ${+ids[0].split(":")[1] + 1}` : `${ids.length} objects: ${kinds.join(", ")}`;
      const keys = KEYS[kinds[0]].filter((key) => kinds.every((kind) => KEYS[kind].includes(key)) && (ids.length === 1 || key !== "name"));
      this.object.replaceChildren(title, this.#grid(keys, things, kinds[0]));
    }
    const name = this.#grid(["name"], [model.draft], "playpen");
    const parts = PARTS.map(([part, keys]) => {
      const set = document.createElement("fieldset");
      const legend = document.createElement("legend");
      legend.textContent = part;
      set.append(legend, this.#grid(keys, [model.draft[part]], part));
      return set;
    });
    this.playpen.replaceChildren(name, ...parts, this.#surfaces());
  }

  // Numbers only, while something is dragged.
  fresh(all = false) {
    for (const { input, key, things } of this.bound ?? []) {
      if (input.fill) {
        if (all) input.fill();
        continue;
      }
      const value = common(things, key);
      if (input.type === "number" ? all || input !== document.activeElement : all && TEXTS.has(key)) input.value = value ?? "";
      else if (all && LISTS.has(key)) input.value = listed(value);
    }
  }

  // Undo takes back what is typed in a field and not taken yet, or else the last change of the drawing.
  #key(event) {
    const back = undoKey(event);
    if (back === null) return;
    event.preventDefault();
    event.stopPropagation();
    const { id, value: typed } = event.target;
    if (back) this.fresh(true);
    if (event.target.value !== typed) return event.target.setCustomValidity("");
    if (back) this.model.undo();
    else this.model.redo();
    if (id) document.getElementById(id)?.focus({ preventScroll: true });
  }

  #commit() {
    this.taking = true;
    this.model.commit();
    this.taking = false;
  }

  #grid(keys, things, kind) {
    const grid = document.createElement("div");
    grid.className = "fields";
    for (const key of keys) {
      const id = `field-${kind}-${key}`;
      const label = document.createElement("label");
      const unit = WORDS[key.split("_").at(-1)];
      label.textContent = unit && key.includes("_") ? `${key.slice(0, key.lastIndexOf("_")).replaceAll("_", " ")} [${unit}]` : key;
      label.htmlFor = id;
      const input = this.#input(key, things, kind);
      input.id = id;
      grid.append(label, input);
      this.bound.push({ input, key, things });
    }
    return grid;
  }

  #input(key, things, kind) {
    if (key === "turrets") return this.#turrets(things);
    const value = common(things, key);
    const choices = key === "surface" ? [...Object.keys(this.surfaces), ...Object.keys(this.model.draft.surfaces ?? {})] : CHOICES[`${kind}.${key}`] ?? CHOICES[key];
    const isBool = key === "movable" || key === "closed";
    const input = document.createElement(choices && kind + key !== "robotmode" ? "select" : "input");
    if (input.tagName === "SELECT") {
      const names = value === undefined || choices.includes(value) ? choices : [...choices, value];
      input.append(...(value === undefined ? [new Option("", "")] : []), ...names.map((name) => new Option(name, name)));
      input.value = value ?? "";
    } else if (isBool) {
      input.type = "checkbox";
      input.checked = value === true;
    } else if (LISTS.has(key) || TEXTS.has(key) && !(kind === "robot" && key === "mode")) {
      input.value = LISTS.has(key) ? listed(value) : value ?? "";
      if (LISTS.has(key)) input.title = EXAMPLES[key] ?? "numbers, such as [0, 0], [600, 0]";
    } else {
      input.type = "number";
      input.step = "any";
      input.value = value ?? "";
    }
    input.addEventListener("change", () => this.#take(input, key, things));
    return input;
  }

  #take(input, key, things) {
    let value;
    if (input.type === "checkbox") value = input.checked;
    else if (input.type === "number") value = input.value === "" ? undefined : input.valueAsNumber;
    else if (LISTS.has(key)) {
      try {
        value = input.value.trim() ? JSON.parse(`[${input.value}]`) : undefined;
      } catch {
        return wrong(input, "expected values with commas between them");
      }
      // Drawn as it is typed, so it has to have corners.
      if (PLACES.has(key) && !(value ?? []).every((at) => at?.length === 2 && at.every?.((each) => Math.abs(each) <= 1e5 && typeof each === "number")))
        return wrong(input, "expected positions, such as [0, 0], [600, 0]");
      if (key === "points_mm" && !(value?.length > 1)) return wrong(input, "expected two positions or more, such as [0, 0], [600, 0]");
      input.setCustomValidity("");
    } else value = input.value || undefined;
    for (const thing of things) {
      if (value === undefined) delete thing[key];
      else thing[key] = value;
      if (key === "model") {
        thing.calibration = value;
        thing.rom = value === "khepera2" ? "khepera2" : "5.02";
      }
    }
    this.#commit();
  }

  // A box for each turret that is installed, and for those that are only named here.
  #turrets(things) {
    const group = Object.assign(document.createElement("div"), { className: "row" });
    group.setAttribute("role", "group");
    const named = things.flatMap((thing) => thing.turrets ?? []);
    const order = [...new Set([...Object.keys(this.turrets), ...named])];
    const boxes = order.map((name) => {
      const box = Object.assign(document.createElement("input"), { type: "checkbox", value: name });
      box.addEventListener("change", () => {
        for (const thing of things) {
          const others = (thing.turrets ?? []).filter((each) => each !== name);
          // A new one comes on those that stack below it.
          const above = others.findIndex((each) => order.indexOf(each) > order.indexOf(name));
          if (box.checked) others.splice(above < 0 ? others.length : above, 0, name);
          thing.turrets = others;
        }
        this.#commit();
      });
      const label = Object.assign(document.createElement("label"), { title: this.turrets[name]?.description ?? "not installed" });
      label.append(box, ` ${name}`);
      group.append(label);
      return box;
    });
    group.fill = () => {
      for (const box of boxes) {
        const count = things.filter((thing) => thing.turrets?.includes(box.value)).length;
        box.checked = count === things.length;
        box.indeterminate = count > 0 && count < things.length;
      }
    };
    group.fill();
    return group;
  }

  #surfaces() {
    const set = document.createElement("fieldset");
    set.innerHTML = "<legend>surfaces</legend>";
    const { draft } = this.model;
    for (const [name, surface] of Object.entries(draft.surfaces ?? {})) {
      const row = document.createElement("div");
      row.className = "row";
      const title = document.createElement("strong");
      title.textContent = name;
      const reflects = Object.assign(document.createElement("input"), { type: "number", step: "any", value: surface.reflectance, title: "infrared reflectance, white = 1" });
      reflects.setAttribute("aria-label", `reflectance of ${name}`);
      reflects.addEventListener("change", () => {
        surface.reflectance = reflects.valueAsNumber;
        this.#commit();
      });
      const colour = Object.assign(document.createElement("input"), { type: "color", value: `#${surface.rgb.map((part) => part.toString(16).padStart(2, "0")).join("")}` });
      colour.setAttribute("aria-label", `colour of ${name}`);
      colour.addEventListener("change", () => {
        surface.rgb = [1, 3, 5].map((at) => parseInt(colour.value.slice(at, at + 2), 16));
        this.#commit();
      });
      const away = Object.assign(document.createElement("button"), { textContent: "Remove" });
      away.addEventListener("click", () => {
        delete draft.surfaces[name];
        this.model.commit();
      });
      this.bound.push({ input: reflects, key: "reflectance", things: [surface] });
      row.append(title, reflects, colour, away);
      set.append(row);
    }
    const add = Object.assign(document.createElement("button"), { textContent: "New surface" });
    add.addEventListener("click", () => {
      draft.surfaces ??= {};
      let number = 1;
      while (draft.surfaces[`surface${number}`]) number++;
      draft.surfaces[`surface${number}`] = { reflectance: 0.6, rgb: [180, 140, 90] };
      this.model.commit();
    });
    set.append(add);
    return set;
  }
}

const listed = (value) => (value === undefined ? "" : JSON.stringify(value).slice(1, -1));

function wrong(input, text) {
  input.setCustomValidity(text);
  input.reportValidity();
}

function common(things, key) {
  const [first, ...others] = things.map((thing) => thing[key]);
  return others.every((other) => JSON.stringify(other) === JSON.stringify(first)) ? first : undefined;
}
