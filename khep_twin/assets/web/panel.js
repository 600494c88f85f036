// khepbase: the robot from above, a pair of bars at each sensor and a bar at each motor, as the toolbox has it.

import { make } from "./drawing.js";

export const SENSORS = ["left 90", "left 45", "left 10", "right 10", "right 45", "right 90", "back right", "back left"];
const BAR = 15;
const [RED, ORANGE, BLUE] = ["var(--red)", "var(--orange)", "var(--blue)"];

export class Panel {
  #bars = {};

  constructor(svg, table) {
    Object.assign(this, { svg, table });
    const rows = SENSORS.map((name) => {
      const row = document.createElement("tr");
      row.append(...[name, "–", "–"].map((text) => Object.assign(document.createElement("td"), { textContent: text })));
      return row;
    });
    const head = document.createElement("tr");
    head.append(...["sensor", "proximity", "light"].map((text) => Object.assign(document.createElement("th"), { textContent: text })));
    const last = document.createElement("tr");
    last.append(...["speed left, right", "–", "–"].map((text) => Object.assign(document.createElement("td"), { textContent: text })));
    table.replaceChildren(head, ...rows, last);
    this.rows = [...rows, last];
  }

  // The kinds of bars by name, each with the value that fills it and its entry in the legend.
  limits(bars, legend) {
    this.#bars = bars;
    const entries = Object.entries(bars).map(([name, bar]) => {
      const entry = document.createElement("span");
      entry.append(Object.assign(document.createElement("i"), { className: name }), bar.legend);
      return entry;
    });
    legend.replaceChildren(...entries);
  }

  // Ahead is up, left is left.
  shape({ radius_mm: radius, sensors }) {
    const bar = (x, y, fill, name) => make("rect", { x: x - 2, y, width: 4, height: 0, fill, class: name });
    const ground = (x, y, height) => make("rect", { x: x - 2, y: y - height, width: 4, height, fill: "var(--groove)" });
    this.near = [];
    this.light = [];
    const parts = [make("circle", { r: radius, fill: "var(--robot)", stroke: "var(--edge)" }), make("path", { d: `M-5 ${-radius + 9}L0 ${-radius + 3}L5 ${-radius + 9}`, fill: "none", stroke: "var(--edge)", "stroke-width": 1.4 })];
    for (const [ahead, left] of sensors) {
      const [x, y] = [-left * 1.5, -ahead * 1.5 + (ahead > 0 ? 3 : 12)];
      const [near, light] = [bar(x - 2.4, y, RED, "proximity"), bar(x + 2.4, y, ORANGE, "light")];
      parts.push(ground(x - 2.4, y, BAR), ground(x + 2.4, y, BAR), near, light);
      this.near.push([near, y]);
      this.light.push([light, y]);
    }
    this.motors = [-1, 1].map((side) => {
      const motor = bar(side * 15, 0, BLUE, "speed");
      parts.push(make("rect", { x: side * 22 - 1.2, y: -7.5, width: 2.4, height: 15, fill: "var(--wheel)" }), make("rect", { x: side * 15 - 2, y: -BAR, width: 4, height: 2 * BAR, fill: "var(--groove)" }), make("path", { d: `M${side * 15 - 3} 0h6`, stroke: "var(--edge)" }), motor);
      return motor;
    });
    this.svg.replaceChildren(...parts);
  }

  read({ proximity, ambient, speed }) {
    const part = (name, value) => Math.min(Math.abs(value) / this.#bars[name].full, 1);
    proximity.forEach((count, index) => {
      rise(...this.near[index], part("proximity", count) * BAR);
      rise(...this.light[index], part("light", ambient[index]) * BAR);
      write(this.rows[index].children[1], count);
      write(this.rows[index].children[2], ambient[index]);
    });
    speed.slice(0, 2).forEach((pulses, side) => {
      const height = part("speed", pulses) * BAR;
      this.motors[side].setAttribute("y", pulses > 0 ? -height : 0);
      this.motors[side].setAttribute("height", height);
      write(this.rows[8].children[side + 1], pulses);
    });
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

function rise(bar, foot, height) {
  bar.setAttribute("y", foot - height);
  bar.setAttribute("height", height);
}
