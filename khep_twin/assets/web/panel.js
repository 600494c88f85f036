// The robot from above as in the toolbox's khepbase: a pair of bars at each sensor, a bar at each motor.

import { createSvg } from "./drawing.js";
import { create, createRow, setText } from "./page.js";

const BAR = 15;
const [RED, ORANGE, BLUE] = ["var(--red)", "var(--orange)", "var(--blue)"];

export class Panel {
  #bars = {};

  constructor(svg, table, legend) {
    Object.assign(this, { svg, table, legend });
  }

  // Creates a row for each sensor and the wheels; other channels get theirs with their first reading.
  #createRows(names) {
    const head = create("tr", {}, ...["sensor", "proximity", "light"].map((text) => create("th", {}, text)));
    this.rows = [...names.map((name) => createRow(name, "–", "–")), createRow("speed left, right", "–", "–")];
    this.channelRows = {};
    this.table.replaceChildren(head, ...this.rows);
  }

  // Takes the kinds of bars by name, each with its full-scale value and its entry in the legend.
  #setBars(bars) {
    this.#bars = bars;
    this.legend.replaceChildren(...Object.entries(bars).map(([className, bar]) => create("span", {}, create("i", { className }), bar.legend)));
  }

  // Draws a robot with its front up. A large robot is scaled down; ground sensors have their bars in a row within it.
  drawRobot({ radius_mm, sensors: sensors_mm, names, n_ground, wheels_mm, bars }) {
    this.#createRows(names);
    this.#setBars(bars);
    const scale = n_ground || radius_mm > 40 ? 27.5 / radius_mm : 1;
    const [radius, base] = [radius_mm * scale, wheels_mm[0] * scale];
    const sensors = sensors_mm.map(([ahead, left]) => [ahead * scale, left * scale]);
    const bar = (x, y, fill, name) => createSvg("rect", { x: x - 2, y, width: 4, height: 0, fill, class: name });
    const groove = (x, y, height) => createSvg("rect", { x: x - 2, y: y - height, width: 4, height, fill: "var(--groove)" });
    this.proximityBars = [];
    this.lightBars = [];
    const parts = [createSvg("circle", { r: radius, fill: "var(--robot)", stroke: "var(--edge)" }), createSvg("path", { d: nosePath(n_ground ? radius + 7 : radius - 3), fill: "none", stroke: "var(--edge)", "stroke-width": 1.4 })];
    const addBars = (x, y, offset, height) => {
      const [proximity, light] = [bar(x - offset, y, RED, "proximity"), bar(x + offset, y, ORANGE, "light")];
      parts.push(groove(x - offset, y, height), groove(x + offset, y, height), proximity, light);
      this.proximityBars.push([proximity, y, height]);
      this.lightBars.push([light, y, height]);
    };
    for (const [ahead, left] of sensors) addBars(-left * 1.5, -ahead * 1.5 + (ahead > 0 ? 3 : 12), 2.4, BAR);
    for (let index = 0; index < n_ground; index++) addBars(8.8 * (index - (n_ground - 1) / 2), -15.5, 2.2, 9);
    this.motors = [-1, 1].map((side) => {
      const motor = bar(side * 15, 0, BLUE, "speed");
      parts.push(createSvg("rect", { x: side * (n_ground ? base / 2 : 22) - 1.2, y: -7.5, width: 2.4, height: 15, fill: "var(--wheel)" }), createSvg("rect", { x: side * 15 - 2, y: -BAR, width: 4, height: 2 * BAR, fill: "var(--groove)" }), createSvg("path", { d: `M${side * 15 - 3} 0h6`, stroke: "var(--edge)" }), motor);
      return motor;
    });
    this.svg.replaceChildren(...parts);
  }

  showReadings({ proximity, ambient, speed, more: channels = {} }) {
    const fraction = (name, value) => Math.min(Math.abs(value) / this.#bars[name].full, 1);
    proximity.forEach((count, index) => {
      setBar(...this.proximityBars[index], fraction("proximity", count));
      setBar(...this.lightBars[index], fraction("light", ambient[index]));
      setText(this.rows[index].children[1], count ?? "–");
      setText(this.rows[index].children[2], ambient[index] ?? "–");
    });
    speed.slice(0, 2).forEach((pulses, side) => {
      const height = fraction("speed", pulses) * BAR;
      this.motors[side].setAttribute("y", pulses > 0 ? -height : 0);
      this.motors[side].setAttribute("height", height);
      setText(this.rows.at(-1).children[side + 1], pulses ?? "–");
    });
    for (const [name, values] of Object.entries(channels)) {
      if (!this.channelRows[name]) {
        this.channelRows[name] = createRow(name, "");
        this.channelRows[name].lastChild.colSpan = 2;
        this.table.append(this.channelRows[name]);
      }
      setText(this.channelRows[name].lastChild, values.join(", "));
    }
  }
}

// A line image over time, the newest row at the bottom; a row for each 0.1 s.
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

  add({ vision }, time) {
    if (vision === undefined) return; // the image was not read
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

function setBar(bar, bottom, fullHeight, fraction) {
  bar.setAttribute("y", bottom - fraction * fullHeight);
  bar.setAttribute("height", fraction * fullHeight);
}

const nosePath = (tip) => `M-5 ${6 - tip}L0 ${-tip}L5 ${6 - tip}`;
