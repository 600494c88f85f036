// The arena as SVG, in mm with y upwards: one group for each part, with its pose as transform.

import { clampFinite, KINDS, OBJECTS } from "./model.js";

const NS = "http://www.w3.org/2000/svg";
const MAX_STRIPES = 1000; // of a side
const STEPS = [100, 200, 500, 1000, 2000, 5000, 10000]; // distances of the labels of the axes [mm]

export class Drawing {
  constructor(svg, model) {
    this.svg = svg;
    this.model = model;
    this.world = createSvg("g", { transform: "scale(1,-1)" });
    this.ground = createSvg("g");
    this.axes = createSvg("g");
    this.parts = createSvg("g");
    this.liveGroup = createSvg("g");
    this.overlay = createSvg("g");
    this.world.append(this.ground, this.axes, this.parts, this.liveGroup, this.overlay);
    this.labels = createSvg("g");
    svg.append(this.world, this.labels);
    this.nodes = new Map();
    this.surfaces = {};
    this.shapes = {};
    this.turrets = {};
    this.view = { x: 0, y: 0, width: 600, height: 500 };
    new ResizeObserver(() => this.#drawAxes()).observe(svg);
  }

  surfaceColour(name) {
    const surface = this.model.draft.surfaces?.[name] ?? this.surfaces[name];
    return surface ? `rgb(${surface.rgb})` : "#f0f";
  }

  fit() {
    const { width_mm, height_mm, wall_thickness_mm } = this.#arenaSize();
    const showArena = (side, end) => this.setView(-side, -height_mm - end, width_mm + 2 * side, height_mm + 2 * end);
    showArena(wall_thickness_mm, wall_thickness_mm);
    // The axes are beside the arena, and the legend above it, usually in at most two lines; the margin below is as high.
    for (const { pixelMm } of [this, this]) showArena(wall_thickness_mm + 44 * pixelMm, wall_thickness_mm + 50 * pixelMm);
  }

  setView(x, y, width, height) {
    this.view = { x, y, width, height };
    this.svg.setAttribute("viewBox", `${x} ${y} ${width} ${height}`);
    this.#drawAxes();
    this.onView?.();
  }

  // Zooms about a position, by default the centre of the view.
  zoom(factor, position = null) {
    const { x, y, width, height } = this.view;
    const cx = position ? position[0] : x + width / 2;
    const cy = position ? -position[1] : y + height / 2;
    const scale = Math.min(Math.max(width * factor, 40), 30000) / width;
    this.setView(cx - (cx - x) * scale, cy - (cy - y) * scale, width * scale, height * scale);
  }

  // Position of a pointer, in mm.
  pointerPosition(event) {
    const matrix = this.world.getScreenCTM().inverse();
    const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix);
    return [x, y];
  }

  // Size of a screen pixel in mm.
  get pixelMm() {
    return 1 / this.world.getScreenCTM().a;
  }

  drawAll() {
    this.#drawFloor();
    const focusedId = document.activeElement?.dataset?.id;
    this.nodes.clear();
    const nodes = [];
    for (const kind of KINDS)
      this.model.partsOf(kind).forEach((part, index) => {
        const id = `${kind}:${index}`;
        const node = this.createPart(kind, part);
        node.dataset.id = id;
        node.classList.add("part", "drawn", `kind-${kind}`);
        node.setAttribute("tabindex", "0");
        node.setAttribute("role", "img");
        if (part.movable) node.classList.add("movable");
        this.nodes.set(id, node);
        setPose(node, part);
        nodes.push(node);
      });
    this.parts.replaceChildren(...nodes);
    this.markParts();
    if (focusedId) this.nodes.get(focusedId)?.focus({ preventScroll: true });
  }

  updateParts(ids) {
    for (const id of ids) {
      const node = this.nodes.get(id);
      const part = this.model.part(id);
      if (part.points_mm) node.replaceChildren(...this.createPart("wall", part).childNodes);
      else setPose(node, part);
    }
    this.showReasons();
  }

  // Marks the selection, and the parts with problems.
  markParts() {
    const problems = new Map();
    for (const { place: [kind, index], text } of this.model.problems) {
      const id = `${kind}:${index}`;
      if (this.nodes.has(id)) problems.set(id, problems.has(id) ? `${problems.get(id)}\n${text}` : text);
    }
    this.problems = problems; // text by id
    for (const [id, node] of this.nodes) {
      node.classList.toggle("selected", this.model.selected.has(id));
      node.classList.toggle("bad", problems.has(id));
      const [kind, index] = id.split(":");
      const part = this.model.part(id);
      const position = part.x_mm === undefined ? "" : ` at ${part.x_mm}, ${part.y_mm}`;
      node.setAttribute("aria-label", `${kind} ${+index + 1}${position}${problems.has(id) ? `: ${problems.get(id)}` : ""}`);
    }
    this.showReasons();
  }

  // Shows why the selected parts, or the only part with a problem, cannot be where they are.
  showReasons() {
    const entries = [...(this.problems ?? [])].filter(([id]) => this.model.selected.has(id) || this.problems.size === 1).slice(0, 3);
    this.drawReasons(
      entries.map(([id, text]) => {
        const part = this.model.part(id);
        return [(part.points_mm ? part.points_mm[0] : [part.x_mm, part.y_mm]).map((value) => clampFinite(value)), text, this.shapes[part.model]?.radius_mm];
      }),
    );
  }

  // Draws reasons, each beside its position, and the robot there of a radius.
  drawReasons(reasons) {
    const size = 13 * this.pixelMm;
    this.labels.replaceChildren(
      ...reasons.map(([[x, y], text, radius = 27]) => {
        const offset = radius + 5 * this.pixelMm;
        const lines = text.split("\n")[0].replace(/^[^:]*? (overlaps|is outside)/, "$1").split(/; expected /);
        const { width_mm } = this.model.draft.arena;
        const isRight = x > width_mm / 2; // its text ends at the part
        const label = createSvg("text", { class: "why", "text-anchor": isRight ? "end" : "start" });
        label.style.fontSize = `${size}px`;
        label.style.strokeWidth = `${size / 3}px`;
        lines.forEach((content, line) =>
          label.append(
            Object.assign(createSvg("tspan", { x: x + (isRight ? -offset : offset), y: -y + line * size * 1.2 }), {
              textContent: line ? `→ ${content}` : `! ${content}`,
            }),
          ),
        );
        return label;
      }),
    );
  }

  createPart(kind, part) {
    if (kind in OBJECTS || kind === "patch") {
      const fill = this.surfaceColour(part.surface);
      const isRound = (OBJECTS[kind] ?? part).radius_mm !== undefined;
      const shape = isRound ? createSvg("circle", { r: Math.max(clampFinite(part.radius_mm), 0), class: "shape", fill }) : createRectangle(part.length_mm, part.width_mm, fill);
      if (kind === "patch") shape.setAttribute("fill-opacity", "0.55");
      const sides = isRound ? [circleSide(clampFinite(part.radius_mm))] : rectangleSides(clampFinite(part.length_mm), clampFinite(part.width_mm));
      const [half, tip] = [0.35 * clampFinite(part.length_mm), 0.1 * clampFinite(part.length_mm)];
      const arrow = part.ramp ? [createSvg("path", { class: "nose", d: `M${-half} 0H${half}M${half - tip} ${-tip}L${half} 0L${half - tip} ${tip}` })] : []; // points up the ramp
      return createSvg("g", {}, shape, ...this.#createStripes(part, sides), ...arrow);
    }
    if (kind === "wall") {
      const thickness = Math.max(clampFinite(part.thickness_mm), 0);
      const path = `M${part.points_mm.map((point) => point.join(" ")).join("L")}${part.closed ? "Z" : ""}`;
      const corners = part.closed ? [...part.points_mm, part.points_mm[0]] : part.points_mm;
      const sides = corners.slice(1).flatMap((end, index) => wallSides(corners[index], end, thickness / 2));
      return createSvg(
        "g",
        {},
        createSvg("path", { d: path, fill: "none", stroke: "var(--edge)", "stroke-width": thickness + 1.5, "stroke-linejoin": "bevel" }),
        createSvg("path", { d: path, fill: "none", stroke: this.surfaceColour(part.surface), "stroke-width": thickness, "stroke-linejoin": "bevel" }),
        ...this.#createStripes(part, sides),
        createSvg("path", { d: path, fill: "none", class: "shape" }),
      );
    }
    if (kind === "lamp") {
      const colour = `rgb(${part.rgb ?? [255, 217, 77]})`;
      const glow = 12 + 14 * Math.sqrt(Math.min(Math.max(clampFinite(part.power_w), 0) * Math.max(clampFinite(part.dim, 1), 0), 1000));
      const rays = createSvg("path", { class: "line", d: [0, 45, 90, 135, 180, 225, 270, 315].map((angle) => `M${6.5 * cos(angle)} ${6.5 * sin(angle)}L${10 * cos(angle)} ${10 * sin(angle)}`).join("") });
      return createSvg("g", {}, createSvg("circle", { r: glow, class: "glow", fill: colour, "pointer-events": "none" }), rays, createSvg("circle", { r: 5, class: "shape bulb", fill: colour }), createSvg("circle", { r: 12, fill: "transparent" }));
    }
    if (kind === "spot") return createSvg("g", {}, createSvg("circle", { r: 12, class: "shape spot" }), createSvg("path", { class: "nose", d: "M0 0L20 0M14 -4L20 0L14 4" }), createSvg("circle", { r: 12, fill: "transparent" }));
    return this.createRobot(part.model, part.turrets);
  }

  createRobot(kind = "khepera1", turrets = [], robotShape = null) {
    const { radius_mm: radius, sensors, wheels_mm: [base, wheelRadius, wheelWidth] } = robotShape ?? this.shapes[kind] ?? { radius_mm: 27.5, sensors: [], wheels_mm: [52, 7.64, 3] };
    const wheels = [-base / 2, base / 2].map((y) => createSvg("rect", { x: -wheelRadius, y: y - wheelWidth / 2, width: 2 * wheelRadius, height: wheelWidth, fill: "var(--wheel)" }));
    const sensorDots = sensors.map(([x, y]) => createSvg("circle", { cx: x, cy: y, r: 1.8, fill: "var(--blue)" }));
    const nose = createSvg("path", { class: "nose", d: `M${radius - 12} -7L${radius - 3} 0L${radius - 12} 7` });
    return createSvg("g", {}, createSvg("circle", { r: radius, class: "shape body" }), ...wheels, ...this.#createTurrets(turrets), nose, ...sensorDots);
  }

  #arenaSize() {
    const { arena } = this.model.draft;
    return { width_mm: Math.max(clampFinite(arena.width_mm), 1), height_mm: Math.max(clampFinite(arena.height_mm), 1), wall_thickness_mm: Math.max(clampFinite(arena.wall_thickness_mm, 10), 0) };
  }

  // Creates the parts of turrets in their initial poses; a turret that is not installed has none.
  #createTurrets(names) {
    const parts = names.flatMap((name) => this.turrets[name]?.parts ?? []);
    return parts.map(({ points_mm, rgb }) => createSvg("path", { class: "turret", d: closedPath(points_mm), fill: `rgb(${rgb})` }));
  }

  // Creates a part's stripes as lines along its sides: polylines from left to right as seen from in front of the side.
  #createStripes(part, sides) {
    const stripes = readStripes(part);
    return sides.flatMap((side) =>
      splitStripes(polylineLength(side), stripes).map(([from, to, name]) =>
        createSvg("path", { d: `M${cutPolyline(side, from, to).map((point) => point.join(" ")).join("L")}`, fill: "none", stroke: this.surfaceColour(name), "stroke-width": 3, "pointer-events": "none" }),
      ),
    );
  }

  #drawFloor() {
    const { arena } = this.model.draft;
    const { width_mm: width, height_mm: height, wall_thickness_mm: thickness } = this.#arenaSize();
    const { outline_mm: outline = [] } = arena;
    const corners = outline.length ? outline : [[0, 0], [width, 0], [width, height], [0, height]];
    const path = closedPath(corners);
    const walls = arena.table ? [] : [
      createSvg("path", { d: path, class: "wall-around", "stroke-width": 2 * thickness, "stroke-linejoin": "miter" }),
      createSvg("path", { d: path, fill: "none", stroke: this.surfaceColour(arena.surface ?? "white"), "stroke-width": Math.max(2 * thickness - 3, 1) }),
    ];
    const step = Math.max(width, height) > 2500 ? 500 : 100;
    const lines = [...multiples(step, width).map((x) => `M${x} 0V${height}`), ...multiples(step, height).map((y) => `M0 ${y}H${width}`)].join("");
    this.ground.replaceChildren(
      ...walls,
      createSvg("path", { d: path, class: arena.table ? "floor table" : "floor" }), // a table has an edge instead of walls
      ...this.#createStripes(arena, [...corners].every((corner) => corner.length === 2) ? innerSides(corners) : []),
      createSvg("path", { d: lines, class: "grid" }),
    );
    this.#drawAxes();
  }

  // Draws the labels of the axes, in the same size at any zoom, as many as have room.
  #drawAxes() {
    const { width_mm: width, height_mm: height, wall_thickness_mm: thickness } = this.#arenaSize();
    const { pixelMm } = this;
    if (!(pixelMm < Infinity)) return; // the plan is hidden
    const step = STEPS.find((step) => step > 44 * pixelMm) ?? STEPS.at(-1);
    const texts = [
      ...multiples(step, width).map((x) => [x, -thickness - 14 * pixelMm, x, "middle"]),
      ...multiples(step, height).map((y) => [-thickness - 4 * pixelMm, y - 4 * pixelMm, y, "end"]),
    ];
    this.axes.replaceChildren(...texts.map(([x, y, text, anchor]) => Object.assign(createSvg("text", { class: "axis", transform: `translate(${x} ${y}) scale(${pixelMm} ${-pixelMm})`, "text-anchor": anchor }), { textContent: text })));
  }
}

export function createSvg(name, keys = {}, ...children) {
  const element = document.createElementNS(NS, name);
  for (const [key, value] of Object.entries(keys)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

export function setPose(node, part) {
  if (part.points_mm) return;
  const rotation = clampFinite(part.heading_deg ?? part.angle_deg);
  node.setAttribute("transform", `translate(${clampFinite(part.x_mm)} ${clampFinite(part.y_mm)}) rotate(${rotation})`);
}

// Returns a part's stripes, widths and names of surfaces; none if they are invalid.
export function readStripes(part) {
  const stripes = Array.isArray(part.stripes) ? part.stripes : [];
  return stripes.every((stripe) => Array.isArray(stripe) && stripe[0] >= 1 && typeof stripe[1] === "string") ? stripes : [];
}

// Repeats stripes over a length; returns the start, end and surface of each.
function splitStripes(length, stripes) {
  const intervals = [];
  for (let from = 0, count = 0; stripes.length && from < length - 1e-6 && count < MAX_STRIPES; count++) {
    const [width, name] = stripes[count % stripes.length];
    intervals.push([from, Math.min(from + width, length), name]);
    from += width;
  }
  return intervals;
}

const distance = ([x0, y0], [x1, y1]) => Math.hypot(x1 - x0, y1 - y0);
const polylineLength = (side) => side.slice(1).reduce((sum, point, index) => sum + distance(side[index], point), 0);

// Returns the section of a polyline between two distances from its start.
function cutPolyline(side, from, to) {
  const points = [];
  let start = 0;
  side.slice(1).forEach((end, index) => {
    const length = distance(side[index], end);
    const interpolate = (distance) => [0, 1].map((axis) => side[index][axis] + ((distance - start) / length) * (end[axis] - side[index][axis]));
    if (length && start + length > from && start < to) {
      if (!points.length) points.push(interpolate(Math.max(from, start)));
      points.push(interpolate(Math.min(to, start + length)));
    }
    start += length;
  });
  return points;
}

const circleSide = (radius) => Array.from({ length: 61 }, (_, index) => [radius * cos(6 * index), radius * sin(6 * index)]);

function rectangleSides(length, width) {
  const [x, y] = [length / 2, width / 2];
  const corners = [[-x, -y], [x, -y], [x, y], [-x, y]];
  return corners.map((corner, index) => [corner, corners[(index + 1) % 4]]);
}

function wallSides([x0, y0], [x1, y1], half) {
  const length = Math.hypot(x1 - x0, y1 - y0) || 1;
  const [dx, dy] = [((y1 - y0) / length) * half, ((x0 - x1) / length) * half];
  return [[[x0 + dx, y0 + dy], [x1 + dx, y1 + dy]], [[x1 - dx, y1 - dy], [x0 - dx, y0 - dy]]];
}

// Returns the inner sides of the walls around a floor.
function innerSides(corners) {
  const area = corners.reduce((sum, [x0, y0], index) => sum + x0 * corners[(index + 1) % corners.length][1] - corners[(index + 1) % corners.length][0] * y0, 0);
  const ring = area < 0 ? corners : [...corners].reverse();
  return ring.map((corner, index) => [corner, ring[(index + 1) % ring.length]]);
}

const multiples = (step, end) => Array.from({ length: Math.floor(end / step) + 1 }, (_, index) => index * step);

export const closedPath = (points) => `M${points.map((point) => point.join(" ")).join("L")}Z`;

function createRectangle(length_mm, width_mm, fill) {
  const [width, height] = [length_mm, width_mm].map((value) => Math.max(clampFinite(value), 0));
  return createSvg("rect", { x: -width / 2, y: -height / 2, width, height, class: "shape", fill });
}

const cos = (degrees) => Math.cos((degrees * Math.PI) / 180);
const sin = (degrees) => Math.sin((degrees * Math.PI) / 180);
