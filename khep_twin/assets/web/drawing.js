// The arena as SVG, in mm with y upwards: one group for each thing, placed by its transform.

import { drawable, KINDS, OBJECTS } from "./model.js";

const NS = "http://www.w3.org/2000/svg";

export function make(name, keys = {}, ...children) {
  const element = document.createElementNS(NS, name);
  for (const [key, value] of Object.entries(keys)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

export class Drawing {
  constructor(svg, model) {
    this.svg = svg;
    this.model = model;
    this.world = make("g", { transform: "scale(1,-1)" });
    this.ground = make("g");
    this.things = make("g");
    this.live = make("g");
    this.over = make("g");
    this.world.append(this.ground, this.things, this.live, this.over);
    this.labels = make("g");
    svg.append(this.world, this.labels);
    this.nodes = new Map();
    this.surfaces = {};
    this.shapes = {};
    this.turrets = {};
    this.view = { x: 0, y: 0, width: 600, height: 500 };
  }

  colour(name) {
    const found = this.model.draft.surfaces?.[name] ?? this.surfaces[name];
    return found ? `rgb(${found.rgb})` : "#f0f";
  }

  fit() {
    const { width_mm, height_mm, wall_thickness_mm } = this.#arena();
    const edge = wall_thickness_mm + 28;
    const room = (above) => this.look(-edge, -height_mm - edge - above, width_mm + 2 * edge, height_mm + 2 * (edge + above));
    room(0);
    // The legend lies above the arena, in two lines at most where there is width for it; as much is left below.
    room(Math.max(50 * this.pixel - 28, 0));
  }

  #arena() {
    const { arena } = this.model.draft;
    return { width_mm: Math.max(drawable(arena.width_mm), 1), height_mm: Math.max(drawable(arena.height_mm), 1), wall_thickness_mm: Math.max(drawable(arena.wall_thickness_mm, 10), 0) };
  }

  look(x, y, width, height) {
    this.view = { x, y, width, height };
    this.svg.setAttribute("viewBox", `${x} ${y} ${width} ${height}`);
    this.handles?.();
  }

  zoom(factor, at = null) {
    const { x, y, width, height } = this.view;
    const cx = at ? at[0] : x + width / 2;
    const cy = at ? -at[1] : y + height / 2;
    const next = Math.min(Math.max(width * factor, 40), 30000) / width;
    this.look(cx - (cx - x) * next, cy - (cy - y) * next, width * next, height * next);
  }

  // Position of a pointer, in mm.
  point(event) {
    const matrix = this.world.getScreenCTM().inverse();
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix);
    return [at.x, at.y];
  }

  // Size of a screen pixel in mm.
  get pixel() {
    return 1 / this.world.getScreenCTM().a;
  }

  all() {
    this.#floor();
    const focused = document.activeElement?.dataset?.id;
    this.nodes.clear();
    const made = [];
    for (const kind of KINDS)
      this.model.list(kind).forEach((thing, index) => {
        const id = `${kind}:${index}`;
        const node = this.shape(kind, thing);
        node.dataset.id = id;
        node.classList.add("thing", "drawn", `kind-${kind}`);
        node.setAttribute("tabindex", "0");
        node.setAttribute("role", "img");
        if (thing.movable) node.classList.add("movable");
        this.nodes.set(id, node);
        place(node, thing);
        made.push(node);
      });
    this.things.replaceChildren(...made);
    this.marks();
    if (focused) this.nodes.get(focused)?.focus({ preventScroll: true });
  }

  some(ids) {
    for (const id of ids) {
      const node = this.nodes.get(id);
      const thing = this.model.at(id);
      if (thing.points_mm) node.replaceChildren(...this.shape("wall", thing).childNodes);
      else place(node, thing);
    }
    this.why();
  }

  // Marks the selection, and the things with problems.
  marks() {
    const bad = new Map();
    for (const { place: at, text } of this.model.problems) {
      const id = `${at[0]}:${at[1]}`;
      if (this.nodes.has(id)) bad.set(id, bad.has(id) ? `${bad.get(id)}\n${text}` : text);
    }
    this.bad = bad;
    for (const [id, node] of this.nodes) {
      node.classList.toggle("selected", this.model.selected.has(id));
      node.classList.toggle("bad", bad.has(id));
      const [kind, index] = id.split(":");
      const thing = this.model.at(id);
      const where = thing.x_mm === undefined ? "" : ` at ${thing.x_mm}, ${thing.y_mm}`;
      node.setAttribute("aria-label", `${kind} ${+index + 1}${where}${bad.has(id) ? `: ${bad.get(id)}` : ""}`);
    }
    this.why();
  }

  // Reasons why the selected things, or the only wrong one, cannot be where they are.
  why() {
    const shown = [...(this.bad ?? [])].filter(([id]) => this.model.selected.has(id) || this.bad.size === 1).slice(0, 3);
    this.reasons(
      shown.map(([id, text]) => {
        const thing = this.model.at(id);
        return [(thing.points_mm ? thing.points_mm[0] : [thing.x_mm, thing.y_mm]).map((each) => drawable(each)), text];
      }),
    );
  }

  // Draws reasons beside the positions that they are about.
  reasons(shown) {
    const size = 13 * this.pixel;
    this.labels.replaceChildren(
      ...shown.map(([[x, y], text]) => {
        const words = text.split("\n")[0].replace(/^[^:]*? (overlaps|is outside)/, "$1").split(/; expected /);
        const { width_mm } = this.model.draft.arena;
        const end = x > width_mm / 2;
        const label = make("text", { class: "why", "text-anchor": end ? "end" : "start" });
        label.style.fontSize = `${size}px`;
        label.style.strokeWidth = `${size / 3}px`;
        words.forEach((word, line) =>
          label.append(
            Object.assign(make("tspan", { x: x + (end ? -32 : 32), y: -y + line * size * 1.2 }), {
              textContent: line ? `→ ${word}` : `! ${word}`,
            }),
          ),
        );
        return label;
      }),
    );
  }

  shape(kind, thing) {
    if (kind in OBJECTS || kind === "patch") {
      const fill = this.colour(thing.surface);
      const round = (OBJECTS[kind] ?? thing).radius_mm !== undefined;
      const shape = round ? make("circle", { r: Math.max(drawable(thing.radius_mm), 0), class: "shape", fill }) : rectangle(thing.length_mm, thing.width_mm, fill);
      if (kind === "patch") shape.setAttribute("fill-opacity", "0.55");
      const sides = round ? [circle(drawable(thing.radius_mm))] : rectangleSides(drawable(thing.length_mm), drawable(thing.width_mm));
      const [far, tip] = [0.35 * drawable(thing.length_mm), 0.1 * drawable(thing.length_mm)];
      const up = thing.ramp ? [make("path", { class: "nose", d: `M${-far} 0H${far}M${far - tip} ${-tip}L${far} 0L${far - tip} ${tip}` })] : []; // an arrow up the ramp
      return make("g", {}, shape, ...this.#stripes(thing, sides), ...up);
    }
    if (kind === "wall") {
      const thick = Math.max(drawable(thing.thickness_mm), 0);
      const path = `M${thing.points_mm.map((point) => point.join(" ")).join("L")}${thing.closed ? "Z" : ""}`;
      const ends = thing.closed ? [...thing.points_mm, thing.points_mm[0]] : thing.points_mm;
      const sides = ends.slice(1).flatMap((end, index) => bothSides(ends[index], end, thick / 2));
      return make(
        "g",
        {},
        make("path", { d: path, fill: "none", stroke: "var(--edge)", "stroke-width": thick + 1.5, "stroke-linejoin": "bevel" }),
        make("path", { d: path, fill: "none", stroke: this.colour(thing.surface), "stroke-width": thick, "stroke-linejoin": "bevel" }),
        ...this.#stripes(thing, sides),
        make("path", { d: path, fill: "none", class: "shape" }),
      );
    }
    if (kind === "lamp") {
      const colour = `rgb(${thing.rgb ?? [255, 217, 77]})`;
      const glow = 12 + 14 * Math.sqrt(Math.min(Math.max(drawable(thing.power_w), 0) * Math.max(drawable(thing.dim, 1), 0), 1000));
      const rays = make("path", { class: "line", d: [0, 45, 90, 135, 180, 225, 270, 315].map((a) => `M${6.5 * cos(a)} ${6.5 * sin(a)}L${10 * cos(a)} ${10 * sin(a)}`).join("") });
      return make("g", {}, make("circle", { r: glow, class: "glow", fill: colour, "pointer-events": "none" }), rays, make("circle", { r: 5, class: "shape bulb", fill: colour }), make("circle", { r: 12, fill: "transparent" }));
    }
    if (kind === "spot") return make("g", {}, make("circle", { r: 12, class: "shape spot" }), make("path", { class: "nose", d: "M0 0L20 0M14 -4L20 0L14 4" }), make("circle", { r: 12, fill: "transparent" }));
    return this.robot(thing.model, thing.turrets);
  }

  robot(kind = "khepera1", turrets = [], told = null) {
    const { radius_mm: radius, sensors, wheels_mm: [base, wheel, wide] } = told ?? this.shapes[kind] ?? { radius_mm: 27.5, sensors: [], wheels_mm: [52, 7.64, 3] };
    const wheels = [-base / 2, base / 2].map((y) => make("rect", { x: -wheel, y: y - wide / 2, width: 2 * wheel, height: wide, fill: "var(--wheel)" }));
    const eyes = sensors.map(([x, y]) => make("circle", { cx: x, cy: y, r: 1.8, fill: "var(--blue)" }));
    const nose = make("path", { class: "nose", d: `M${radius - 12} -7L${radius - 3} 0L${radius - 12} 7` });
    return make("g", {}, make("circle", { r: radius, class: "shape body" }), ...wheels, ...this.#turrets(turrets), nose, ...eyes);
  }

  // Parts of turrets, as at start; those that are not installed here have no parts.
  #turrets(names) {
    const parts = names.flatMap((name) => this.turrets[name]?.parts ?? []);
    return parts.map(({ points_mm, rgb }) => make("path", { class: "turret", d: closed(points_mm), fill: `rgb(${rgb})` }));
  }

  // A thing's stripes as lines along its sides, which are points from their left to their right as seen from in front.
  #stripes(thing, sides) {
    const stripes = pattern(thing);
    return sides.flatMap((side) =>
      stretches(lengthOf(side), stripes).map(([from, to, name]) =>
        make("path", { d: `M${along(side, from, to).map((point) => point.join(" ")).join("L")}`, fill: "none", stroke: this.colour(name), "stroke-width": 3, "pointer-events": "none" }),
      ),
    );
  }

  #floor() {
    const { arena } = this.model.draft;
    const { width_mm: width, height_mm: height, wall_thickness_mm: thick } = this.#arena();
    const { outline_mm: outline = [] } = arena;
    const corners = outline.length ? outline : [[0, 0], [width, 0], [width, height], [0, height]];
    const path = closed(corners);
    const walls = arena.table ? [] : [
      make("path", { d: path, class: "wall-around", "stroke-width": 2 * thick, "stroke-linejoin": "miter" }),
      make("path", { d: path, fill: "none", stroke: this.colour(arena.surface ?? "white"), "stroke-width": Math.max(2 * thick - 3, 1) }),
    ];
    const step = Math.max(width, height) > 2500 ? 500 : 100;
    let lines = "";
    const texts = [];
    for (let x = 0; x <= width; x += step) {
      lines += `M${x} 0V${height}`;
      texts.push([x, -thick - 14, x, "middle"]);
    }
    for (let y = 0; y <= height; y += step) {
      lines += `M0 ${y}H${width}`;
      texts.push([-thick - 4, y - 4, y, "end"]);
    }
    this.ground.replaceChildren(
      ...walls,
      make("path", { d: path, class: "floor", ...(arena.table && { style: "stroke: var(--edge); stroke-dasharray: 12 6" }) }), // a table has an edge
      ...this.#stripes(arena, [...corners].every((at) => at.length === 2) ? within(corners) : []),
      make("path", { d: lines, class: "grid" }),
      ...texts.map(([x, y, text, anchor]) => Object.assign(make("text", { class: "axis", transform: `translate(${x} ${y}) scale(1,-1)`, "text-anchor": anchor }), { textContent: text })),
    );
  }
}

export function place(node, thing) {
  if (thing.points_mm) return;
  const turned = drawable(thing.heading_deg ?? thing.angle_deg);
  node.setAttribute("transform", `translate(${drawable(thing.x_mm)} ${drawable(thing.y_mm)}) rotate(${turned})`);
}

// A thing's stripes that can be drawn: widths and names of surfaces.
export function pattern(thing) {
  const given = Array.isArray(thing.stripes) ? thing.stripes : [];
  return given.every((each) => Array.isArray(each) && each[0] >= 1 && typeof each[1] === "string") ? given : [];
}

const STRIPES = 1000;

function stretches(length, stripes) {
  const found = [];
  for (let from = 0, turn = 0; stripes.length && from < length - 1e-6 && turn < STRIPES; turn++) {
    const [width, name] = stripes[turn % stripes.length];
    found.push([from, Math.min(from + width, length), name]);
    from += width;
  }
  return found;
}

const apart = ([x0, y0], [x1, y1]) => Math.hypot(x1 - x0, y1 - y0);
const lengthOf = (side) => side.slice(1).reduce((sum, point, index) => sum + apart(side[index], point), 0);

// The part of a line of points between two distances from its start.
function along(side, from, to) {
  const points = [];
  let start = 0;
  side.slice(1).forEach((end, index) => {
    const length = apart(side[index], end);
    const at = (distance) => [0, 1].map((axis) => side[index][axis] + ((distance - start) / length) * (end[axis] - side[index][axis]));
    if (length && start + length > from && start < to) {
      if (!points.length) points.push(at(Math.max(from, start)));
      points.push(at(Math.min(to, start + length)));
    }
    start += length;
  });
  return points;
}

const circle = (radius) => Array.from({ length: 61 }, (_, turn) => [radius * cos(6 * turn), radius * sin(6 * turn)]);

function rectangleSides(length, width) {
  const [x, y] = [length / 2, width / 2];
  const corners = [[-x, -y], [x, -y], [x, y], [-x, y]];
  return corners.map((corner, index) => [corner, corners[(index + 1) % 4]]);
}

function bothSides([x0, y0], [x1, y1], half) {
  const length = Math.hypot(x1 - x0, y1 - y0) || 1;
  const [dx, dy] = [((y1 - y0) / length) * half, ((x0 - x1) / length) * half];
  return [[[x0 + dx, y0 + dy], [x1 + dx, y1 + dy]], [[x1 - dx, y1 - dy], [x0 - dx, y0 - dy]]];
}

// The inner sides of the walls around a floor.
function within(corners) {
  const area = corners.reduce((sum, [x0, y0], index) => sum + x0 * corners[(index + 1) % corners.length][1] - corners[(index + 1) % corners.length][0] * y0, 0);
  const ring = area < 0 ? corners : [...corners].reverse();
  return ring.map((corner, index) => [corner, ring[(index + 1) % ring.length]]);
}

export const closed = (points) => `M${points.map((point) => point.join(" ")).join("L")}Z`;

function rectangle(length_mm, width_mm, fill) {
  const [width, height] = [length_mm, width_mm].map((each) => Math.max(drawable(each), 0));
  return make("rect", { x: -width / 2, y: -height / 2, width, height, class: "shape", fill });
}

const cos = (degrees) => Math.cos((degrees * Math.PI) / 180);
const sin = (degrees) => Math.sin((degrees * Math.PI) / 180);
