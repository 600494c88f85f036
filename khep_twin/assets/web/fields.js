// Fields for exact values: of each key of the selected parts, and of the playpen's sections.

import { DEFAULTS, OBJECTS, readUndoKey } from "./model.js";
import { $, create } from "./page.js";

const KEYS = {
  ...Object.fromEntries(Object.entries(OBJECTS).map(([kind, keys]) => [kind, ["name", "x_mm", "y_mm", ...Object.keys(keys), "stripes"]])),
  wall: ["name", "points_mm", "closed", "thickness_mm", "height_mm", "surface", "stripes"],
  patch: ["name", "x_mm", "y_mm", "radius_mm", "length_mm", "width_mm", "angle_deg", "surface"],
  lamp: ["name", "x_mm", "y_mm", "z_mm", "power_w", "dim", "rgb", "on_s", "blink_period_s", "blink_duty", "fade_s", "flicker"],
  robot: ["name", "x_mm", "y_mm", "heading_deg", "model", "calibration", "mode", "rom", "turrets", "spots", "battery_used_min"],
  spot: ["name", "x_mm", "y_mm", "heading_deg"],
};
const SECTIONS = [
  ["arena", ["width_mm", "height_mm", "wall_height_mm", "wall_thickness_mm", "surface", "stripes", "outline_mm", "table"]],
  ["lighting", ["mode", "switch_distance_mm", "law", "min_angle_deg", "max_angle_deg", "mains_hz", "room_lux"]],
];
const TEXTS = new Set(["name", "surface", "model", "calibration", "rom", "mode"]);
const FLAGS = new Set(["movable", "closed", "ramp", "table"]);
const LISTS = new Set(["points_mm", "outline_mm", "rgb", "on_s", "spots", "stripes"]);
const POSITIONS = new Set(["points_mm", "outline_mm"]);
const EXAMPLES = { spots: 'names, such as "spot1"', stripes: 'widths and surfaces, such as [20, "black"], [20, "white"]' };
const UNITS = { mm: "mm", deg: "°", w: "W", g: "g", s: "s", min: "min" };

export class Fields {
  // `choices` has the values of keys by table and key; `models` has the keys that fit each model of the robot.
  constructor(model, { surfaces, turrets, choices, models }) {
    Object.assign(this, { model, surfaces, turrets, choices, models });
    this.object = $("#tab-object");
    this.playpen = $("#tab-playpen");
    this.emptyHtml = this.object.innerHTML;
    for (const panel of [this.object, this.playpen]) panel.addEventListener("keydown", (event) => this.#handleKey(event));
    model.addEventListener("change", () => this.show());
    model.addEventListener("moved", () => this.updateValues());
  }

  show() {
    // The edited field is not replaced: Tab goes to the next field.
    if (this.isCommitting) return this.updateValues(true);
    const { model } = this;
    const ids = [...model.selected];
    this.bindings = [];
    if (!ids.length) this.object.innerHTML = this.emptyHtml;
    else {
      const kinds = [...new Set(ids.map((id) => id.split(":")[0]))];
      const parts = ids.map((id) => model.part(id));
      const title = ids.length === 1 ? `${kinds[0]} ${+ids[0].split(":")[1] + 1}` : `${ids.length} objects: ${kinds.join(", ")}`;
      const keys = KEYS[kinds[0]].filter((key) => kinds.every((kind) => KEYS[kind].includes(key)) && (ids.length === 1 || key !== "name"));
      this.object.replaceChildren(create("h3", {}, title), this.#createGrid(keys, parts, kinds[0]));
    }
    const name = this.#createGrid(["name"], [model.draft], "playpen");
    const sections = SECTIONS.map(([section, keys]) => create("fieldset", {}, create("legend", {}, section), this.#createGrid(keys, [model.draft[section]], section)));
    this.playpen.replaceChildren(name, ...sections, this.#createSurfaces());
  }

  // Updates the numbers that a drag changes, or with `isAll` all values.
  updateValues(isAll = false) {
    for (const { input, key, parts } of this.bindings ?? []) {
      if (input.refresh) {
        if (isAll) input.refresh();
        continue;
      }
      const value = commonValue(parts, key);
      if (input.type === "number" ? isAll || input !== document.activeElement : isAll && TEXTS.has(key)) input.value = value ?? "";
      else if (isAll && LISTS.has(key)) input.value = formatList(value);
    }
  }

  // Undo discards what is being typed in a field, or without that undoes the last change of the drawing.
  #handleKey(event) {
    const isUndo = readUndoKey(event);
    if (isUndo === null) return;
    event.preventDefault();
    event.stopPropagation();
    const { id, value: typedText } = event.target;
    if (isUndo) this.updateValues(true);
    if (event.target.value !== typedText) return event.target.setCustomValidity("");
    if (isUndo) this.model.undo();
    else this.model.redo();
    if (id) document.getElementById(id)?.focus({ preventScroll: true });
  }

  #commit() {
    this.isCommitting = true;
    this.model.commit();
    this.isCommitting = false;
  }

  #createGrid(keys, parts, kind) {
    const grid = create("div", { className: "fields" });
    for (const key of keys) {
      const id = `field-${kind}-${key}`;
      const unit = UNITS[key.split("_").at(-1)];
      const text = unit && key.includes("_") ? `${key.slice(0, key.lastIndexOf("_")).replaceAll("_", " ")} [${unit}]` : key;
      const input = this.#createInput(key, parts, kind);
      input.id = id;
      grid.append(create("label", { htmlFor: id }, text), input);
      this.bindings.push({ input, key, parts });
    }
    return grid;
  }

  #createInput(key, parts, kind) {
    if (key === "turrets") return this.#createTurrets(parts);
    const value = commonValue(parts, key);
    const choices = this.#readChoices(key, parts, kind);
    const input = document.createElement(choices && key !== "calibration" ? "select" : "input");
    if (input.matches("select")) {
      const missing = [value ?? ""].filter((name) => !choices.has(String(name))).map((name) => [name, name]);
      input.append(...[...missing, ...choices].map(([name, text]) => new Option(text, name)));
      input.value = value ?? "";
    } else if (FLAGS.has(key)) {
      input.type = "checkbox";
      input.checked = value === true;
    } else if (LISTS.has(key) || TEXTS.has(key)) {
      input.value = LISTS.has(key) ? formatList(value) : value ?? "";
      if (choices) $("#calibrations").replaceChildren(...[...choices.keys()].map((name) => new Option(name)));
      if (choices) input.setAttribute("list", "calibrations"); // suggestions: any file can be typed
      if (LISTS.has(key)) input.title = EXAMPLES[key] ?? "numbers, such as [0, 0], [600, 0]";
    } else {
      input.type = "number";
      input.step = "any";
      input.value = value ?? "";
    }
    input.addEventListener("change", () => this.#setValue(input, key, parts));
    return input;
  }

  // Returns the texts of a key's choices by value, those that fit all parts; undefined for a key without choices.
  #readChoices(key, parts, kind) {
    if (key === "surface") return nameChoices([...Object.keys(this.surfaces), ...Object.keys(this.model.draft.surfaces ?? {})]);
    if (kind !== "robot" || !["rom", "mode", "calibration"].includes(key)) return this.choices[`${kind}.${key}`] && nameChoices(this.choices[`${kind}.${key}`]);
    const modes = (part) => this.models[part.model]?.modes ?? {};
    const names = (part) => (key === "rom" ? Object.keys(modes(part)) : this.models[part.model]?.calibrations ?? []);
    const [first, ...others] = parts.map((part) => new Map(key !== "mode" ? nameChoices(names(part)) : Object.entries(modes(part)[part.rom] ?? {}).map(([mode, text]) => [mode, `${mode}: ${text}`])));
    return new Map([...first].filter(([name]) => others.every((other) => other.has(name))));
  }

  // Replaces the keys of a robot that do not fit its model.
  #fitRobot(part) {
    const { modes, defaults, has_turrets: hasTurrets } = this.models[part.model];
    if (!modes[part.rom]) part.rom = defaults.rom;
    if (!modes[part.rom][part.mode]) part.mode = modes[part.rom][DEFAULTS.robot.mode] ? DEFAULTS.robot.mode : +Object.keys(modes[part.rom])[0];
    if (!hasTurrets) part.turrets = [];
  }

  #setValue(input, key, parts) {
    let value;
    if (input.type === "checkbox") value = input.checked;
    else if (input.type === "number") value = input.value === "" ? undefined : input.valueAsNumber;
    else if (LISTS.has(key)) {
      try {
        value = input.value.trim() ? JSON.parse(`[${input.value}]`) : undefined;
      } catch {
        return rejectInput(input, "expected values with commas between them");
      }
      // The drawing needs valid corners.
      if (POSITIONS.has(key) && !(value ?? []).every((corner) => corner?.length === 2 && corner.every?.((value) => Math.abs(value) <= 1e5 && typeof value === "number")))
        return rejectInput(input, "expected positions, such as [0, 0], [600, 0]");
      if (key === "points_mm" && !(value?.length > 1)) return rejectInput(input, "expected two positions or more, such as [0, 0], [600, 0]");
      input.setCustomValidity("");
    } else value = key === "mode" && parts[0].model ? +input.value : input.value || undefined;
    for (const part of parts) {
      if (value === undefined) delete part[key];
      else part[key] = value;
      if (key === "model") Object.assign(part, this.models[value].defaults);
      if (part.model) this.#fitRobot(part);
    }
    this.#commit();
    if (key === "model" || key === "rom") {
      this.show(); // the choices of other keys differ
      document.getElementById(input.id)?.focus({ preventScroll: true });
    }
  }

  // Creates a box for each installed turret that fits the robots, and for each other turret of theirs.
  #createTurrets(parts) {
    const group = create("div", { className: "row" });
    group.setAttribute("role", "group");
    const names = parts.flatMap((part) => part.turrets ?? []);
    const order = [...new Set([...(parts.every(({ model }) => this.models[model]?.has_turrets) ? Object.keys(this.turrets) : []), ...names])];
    if (!order.length) group.append("none for this model");
    const boxes = order.map((name) => {
      const box = create("input", { type: "checkbox", value: name });
      box.addEventListener("change", () => {
        for (const part of parts) {
          const others = (part.turrets ?? []).filter((other) => other !== name);
          // A new turret is mounted above those that precede it in the order of stacking.
          const index = others.findIndex((other) => order.indexOf(other) > order.indexOf(name));
          if (box.checked) others.splice(index < 0 ? others.length : index, 0, name);
          part.turrets = others;
        }
        this.#commit();
      });
      group.append(create("label", { title: this.turrets[name]?.description ?? "not installed" }, box, ` ${name}`));
      return box;
    });
    group.refresh = () => {
      for (const box of boxes) {
        const count = parts.filter((part) => part.turrets?.includes(box.value)).length;
        box.checked = count === parts.length;
        box.indeterminate = count > 0 && count < parts.length;
      }
    };
    group.refresh();
    return group;
  }

  #createSurfaces() {
    const set = create("fieldset", {}, create("legend", {}, "surfaces"));
    const { draft } = this.model;
    for (const [name, surface] of Object.entries(draft.surfaces ?? {})) {
      const reflectance = create("input", { type: "number", step: "any", value: surface.reflectance, title: "infrared reflectance, white = 1" });
      reflectance.setAttribute("aria-label", `reflectance of ${name}`);
      reflectance.addEventListener("change", () => {
        surface.reflectance = reflectance.valueAsNumber;
        this.#commit();
      });
      const colour = create("input", { type: "color", value: `#${surface.rgb.map((channel) => channel.toString(16).padStart(2, "0")).join("")}` });
      colour.setAttribute("aria-label", `colour of ${name}`);
      colour.addEventListener("change", () => {
        surface.rgb = [1, 3, 5].map((start) => parseInt(colour.value.slice(start, start + 2), 16));
        this.#commit();
      });
      const removeButton = create("button", {}, "Remove");
      removeButton.addEventListener("click", () => {
        delete draft.surfaces[name];
        this.model.commit();
      });
      this.bindings.push({ input: reflectance, key: "reflectance", parts: [surface] });
      set.append(create("div", { className: "row" }, create("strong", {}, name), reflectance, colour, removeButton));
    }
    const addButton = create("button", {}, "New surface");
    addButton.addEventListener("click", () => {
      draft.surfaces ??= {};
      let number = 1;
      while (draft.surfaces[`surface${number}`]) number++;
      draft.surfaces[`surface${number}`] = { reflectance: 0.6, rgb: [180, 140, 90] };
      this.model.commit();
    });
    set.append(addButton);
    return set;
  }
}

const nameChoices = (names) => new Map(names.map((name) => [name, name]));
const formatList = (value) => (value === undefined ? "" : JSON.stringify(value).slice(1, -1));

function rejectInput(input, text) {
  input.setCustomValidity(text);
  input.reportValidity();
}

// Returns the value of a key that all parts have in common; undefined if they differ.
function commonValue(parts, key) {
  const [first, ...others] = parts.map((part) => part[key]);
  return others.every((other) => JSON.stringify(other) === JSON.stringify(first)) ? first : undefined;
}
