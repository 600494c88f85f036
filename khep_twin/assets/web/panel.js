// khepbase: the robot from above, a pair of bars at each sensor and a bar at each motor, as the toolbox has it.

import { make } from "./drawing.js";

export const SENSORS = ["left 90", "left 45", "left 10", "right 10", "right 45", "right 90", "back right", "back left"];
const BAR = 15;
const [RED, ORANGE, BLUE] = ["var(--red)", "var(--orange)", "var(--blue)"];

export class Panel {
  #bars = {};

  constructor(svg, table) {
    Object.assign(this, { svg, table });
    this.#list(SENSORS);
  }

  // A row for each sensor, the wheels, and each further channel of a Khepera IV when it is read.
  #list(names) {
    const head = document.createElement("tr");
    head.append(...["sensor", "proximity", "light"].map((text) => Object.assign(document.createElement("th"), { textContent: text })));
    this.rows = [...names.map((name) => line(name, "–", "–")), line("speed left, right", "–", "–")];
    this.more = {};
    this.table.replaceChildren(head, ...this.rows);
  }

  // The kinds of bars by name, each with the value that fills it and its entry in the legend.
  limits(bars, legend) {
    Object.assign(this, { legend });
    this.#bars = bars;
    const entries = Object.entries(bars).map(([name, bar]) => {
      const entry = document.createElement("span");
      entry.append(Object.assign(document.createElement("i"), { className: name }), bar.legend);
      return entry;
    });
    legend.replaceChildren(...entries);
  }

  // Ahead is up, left is left. A large robot is drawn smaller; what looks at the floor has its bars in a row within it.
  shape({ radius_mm, sensors: around, names, n_ground, wheels_mm, bars }) {
    this.#list(names);
    this.limits(bars, this.legend);
    const scale = n_ground ? 27.5 / radius_mm : 1;
    const [radius, base] = [radius_mm * scale, wheels_mm[0] * scale];
    const sensors = around.map(([ahead, left]) => [ahead * scale, left * scale]);
    const bar = (x, y, fill, name) => make("rect", { x: x - 2, y, width: 4, height: 0, fill, class: name });
    const ground = (x, y, height) => make("rect", { x: x - 2, y: y - height, width: 4, height, fill: "var(--groove)" });
    this.near = [];
    this.light = [];
    const parts = [make("circle", { r: radius, fill: "var(--robot)", stroke: "var(--edge)" }), make("path", { d: nose(n_ground ? radius + 7 : radius - 3), fill: "none", stroke: "var(--edge)", "stroke-width": 1.4 })];
    for (const [ahead, left] of sensors) {
      const [x, y] = [-left * 1.5, -ahead * 1.5 + (ahead > 0 ? 3 : 12)];
      const [near, light] = [bar(x - 2.4, y, RED, "proximity"), bar(x + 2.4, y, ORANGE, "light")];
      parts.push(ground(x - 2.4, y, BAR), ground(x + 2.4, y, BAR), near, light);
      this.near.push([near, y, BAR]);
      this.light.push([light, y, BAR]);
    }
    for (let index = 0; index < n_ground; index++) {
      const [x, y, height] = [8.8 * (index - (n_ground - 1) / 2), -15.5, 9];
      const [near, light] = [bar(x - 2.2, y, RED, "proximity"), bar(x + 2.2, y, ORANGE, "light")];
      parts.push(ground(x - 2.2, y, height), ground(x + 2.2, y, height), near, light);
      this.near.push([near, y, height]);
      this.light.push([light, y, height]);
    }
    this.motors = [-1, 1].map((side) => {
      const motor = bar(side * 15, 0, BLUE, "speed");
      parts.push(make("rect", { x: side * (n_ground ? base / 2 : 22) - 1.2, y: -7.5, width: 2.4, height: 15, fill: "var(--wheel)" }), make("rect", { x: side * 15 - 2, y: -BAR, width: 4, height: 2 * BAR, fill: "var(--groove)" }), make("path", { d: `M${side * 15 - 3} 0h6`, stroke: "var(--edge)" }), motor);
      return motor;
    });
    this.svg.replaceChildren(...parts);
  }

  read({ proximity, ambient, speed, more = {} }) {
    const part = (name, value) => Math.min(Math.abs(value) / this.#bars[name].full, 1);
    proximity.forEach((count, index) => {
      rise(...this.near[index], part("proximity", count));
      rise(...this.light[index], part("light", ambient[index]));
      write(this.rows[index].children[1], count);
      write(this.rows[index].children[2], ambient[index]);
    });
    speed.slice(0, 2).forEach((pulses, side) => {
      const height = part("speed", pulses) * BAR;
      this.motors[side].setAttribute("y", pulses > 0 ? -height : 0);
      this.motors[side].setAttribute("height", height);
      write(this.rows.at(-1).children[side + 1], pulses);
    });
    for (const [name, values] of Object.entries(more)) {
      if (!this.more[name]) {
        this.more[name] = line(name, "");
        this.more[name].lastChild.colSpan = 2;
        this.table.append(this.more[name]);
      }
      write(this.more[name].lastChild, values.join(", "));
    }
  }
}

// A line image over time, the newest row at the bottom, left is left; a row for each 0.1 s.
export class Strip {
  #slot = -1;

  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d", { willReadFrequently: true }); // the strip is copied upwards
  }

  clear() {
    this.#slot = -1;
    this.canvas.hidden = true;
  }

  read({ vision }, time) {
    if (vision === undefined) return; // not read this time
    this.canvas.hidden = !vision;
    const slot = Math.floor(time * 10);
    if (!vision || slot === this.#slot) return;
    const { width, height } = this.canvas;
    if (slot < this.#slot || this.#slot < 0) this.pen.clearRect(0, 0, width, height);
    this.#slot = slot;
    this.pen.drawImage(this.canvas, 0, -1);
    const row = this.pen.createImageData(width, 1);
    vision.forEach((grey, pixel) => row.data.set([grey, grey, grey, 255], 4 * pixel));
    this.pen.putImageData(row, 0, height - 1);
  }
}

// An unchanged text costs no layout.
export function write(node, text) {
  if (node.textContent !== `${text}`) node.textContent = text;
}

function rise(bar, foot, full, part) {
  bar.setAttribute("y", foot - part * full);
  bar.setAttribute("height", part * full);
}

const nose = (tip) => `M-5 ${6 - tip}L0 ${-tip}L5 ${6 - tip}`;

// A row of a table.
function line(...texts) {
  const row = document.createElement("tr");
  row.append(...texts.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
  return row;
}
