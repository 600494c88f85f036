// Curves of a robot's readings over the last 20 s of simulated time, drawn at most once per frame and only in view.

import { create, setText } from "./page.js";

const SPAN = 20; // shown [s]
const SLOT = 0.04; // interval of the samples, each the last of its slot [s]
const SIZE = 512; // capacity of a ring buffer: more than SPAN / SLOT samples
// Plots: `n` values of a sample from index `first`, with the colours of the legend from index `entry`.
const createPlots = (n, unit) => ({
  proximity: { title: "proximity [counts]", first: 0, n, entry: 0, lowest: 0 },
  light: { title: "light [counts, low is bright]", first: n, n, entry: 0, lowest: 0 },
  speed: { title: `speeds of the wheels [${unit}]`, first: 2 * n, n: 2, entry: n, lowest: -1 },
});
const [LEFT, RIGHT, TITLE, PLOT, HEIGHT, FOOT] = [46, 8, 17, 76, 101, 22]; // [px]

export class Curves {
  #buffers = [new RingBuffer([])];
  #robots = [];
  #colourTable = {};
  #plots = createPlots(0);
  #selected = 0;
  #isInView = false;
  #frame = 0;
  #pointer = null; // its position over the canvas [px]
  #fullScale = {};
  #colours = [];

  // `root` has a canvas, a box for each plot, a list for the legend and an output for the time at the pointer.
  constructor(root) {
    Object.assign(this, { root, canvas: root.querySelector("canvas"), list: root.querySelector("ul"), timeOutput: root.querySelector("output") });
    this.pen = this.canvas.getContext("2d");
    this.boxes = Object.fromEntries([...root.querySelectorAll("input")].map((box) => [box.value, box]));
    for (const box of Object.values(this.boxes)) box.addEventListener("change", () => this.#requestFrame());
    for (const kind of ["pointermove", "pointerdown", "pointerleave"])
      this.canvas.addEventListener(kind, (event) => {
        this.#pointer = kind === "pointerleave" ? null : [event.offsetX, event.offsetY];
        this.#requestFrame();
      });
    new IntersectionObserver((entries) => {
      this.#isInView = entries.at(-1).isIntersecting;
      this.#requestFrame();
    }).observe(root);
    new ResizeObserver(() => this.#requestFrame()).observe(root);
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.dark.addEventListener("change", () => this.curves && this.#updateColours());
  }

  // Takes the colours of sensors and wheels by name.
  setColours(colours) {
    this.#colourTable = colours;
  }

  #createLegend({ names, bars, speed_unit: unit }) {
    const { sensors, wheels } = this.#colourTable;
    this.#plots = createPlots(names.length, unit);
    this.#fullScale = Object.fromEntries(Object.entries(bars).map(([name, { full }]) => [name, full]));
    const wheelColours = Object.entries(wheels).map(([side, colour]) => [`${side} wheel`, colour]);
    this.curves = [...names.map((name) => [name, sensors[name] ?? sensors.back]), ...wheelColours].map(([name, colour]) => {
      const [entry, chip, value] = ["li", "i", "b"].map((tag) => create(tag));
      entry.append(chip, name, value);
      return { colour, entry, chip, value };
    });
    this.list.replaceChildren(...this.curves.map(({ entry }) => entry));
    this.#updateColours();
  }

  // Clears the curves for a new run with these robots; the axes show at least the full-scale values of their bars.
  clear(robots) {
    this.#robots = robots;
    this.#buffers = robots.map(({ names }) => new RingBuffer(names));
    this.root.hidden = false;
    this.selectRobot(0);
  }

  selectRobot(index) {
    this.#selected = index;
    this.#createLegend(this.#robots[index]);
  }

  add({ time, robots }) {
    robots.forEach((reading, index) => this.#buffers[index]?.add(time, reading));
    this.#requestFrame();
  }

  // The colours suit a black background; on white they are darkened.
  #updateColours() {
    const brightness = this.dark.matches ? 1 : 0.68;
    this.#colours = this.curves.map(({ colour }) => `rgb(${colour.map((channel) => Math.round(channel * brightness)).join(" ")})`);
    this.curves.forEach(({ chip }, curve) => (chip.style.background = this.#colours[curve]));
    const style = getComputedStyle(this.canvas);
    [this.ink, this.faint, this.line] = ["--ink", "--faint", "--line"].map((name) => style.getPropertyValue(name));
    this.#requestFrame();
  }

  #requestFrame() {
    if (this.#isInView && this.curves) this.#frame ||= requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    this.#frame = 0;
    const { canvas, pen } = this;
    const plots = Object.keys(this.#plots).filter((name) => this.boxes[name].checked);
    this.curves.forEach(({ entry }, curve) => (entry.hidden = !plots.some((name) => (name === "speed") === curve >= this.#plots.speed.entry)));
    canvas.hidden = !plots.length;
    if (!canvas.clientWidth) return;
    const [width, height, scale] = [canvas.clientWidth, plots.length * HEIGHT + FOOT, devicePixelRatio];
    const pixels = [Math.round(width * scale), Math.round(height * scale)];
    if (canvas.width !== pixels[0] || canvas.height !== pixels[1]) [canvas.width, canvas.height] = pixels;
    canvas.style.height = `${height}px`;
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "11px system-ui, sans-serif";
    const buffer = this.#buffers[this.#selected];
    const start = buffer.n ? Math.max(buffer.time(buffer.n - 1) - SPAN, buffer.time(buffer.findFirst(-Infinity))) : 0;
    const x = (time) => LEFT + ((time - start) / SPAN) * (width - LEFT - RIGHT);
    const pointedPlot = this.#pointer && buffer.n ? plots[Math.min(Math.floor(this.#pointer[1] / HEIGHT), plots.length - 1)] : undefined;
    const pointedSample = pointedPlot ? buffer.findNearest(start + ((this.#pointer[0] - LEFT) / (width - LEFT - RIGHT)) * SPAN) : null;
    plots.forEach((name, index) => this.#drawPlot(name, index * HEIGHT + TITLE, { buffer, start, x, pointedSample, width }));
    pen.fillStyle = this.faint;
    pen.textAlign = "center";
    for (const tick of tickTimes(start)) pen.fillText(tick, x(tick), height - 17);
    pen.fillText("time [s]", x(start + SPAN / 2), height - 4);
    this.#showValues(buffer, pointedSample, pointedPlot);
  }

  // Draws the axes and curves of a plot, with its upper edge at `top` [px].
  #drawPlot(name, top, { buffer, start, x, pointedSample, width }) {
    const { pen } = this;
    const { title, first, n, entry, lowest } = this.#plots[name];
    const firstSample = Math.max(buffer.findFirst(start) - 1, buffer.n - SIZE, 0);
    let maximum = 0;
    for (let sample = firstSample; sample < buffer.n; sample++) for (let curve = first; curve < first + n; curve++) maximum = Math.max(maximum, Math.abs(buffer.value(sample, curve)));
    const axisEnd = Math.max(this.#fullScale[name], Math.ceil(maximum / 10) * 10 * (maximum > this.#fullScale[name]));
    const y = (value) => top + PLOT * (1 - (value / axisEnd - lowest) / (1 - lowest));
    pen.fillStyle = this.ink;
    pen.textAlign = "left";
    pen.fillText(title, LEFT, top - 5);
    pen.lineWidth = 1;
    pen.strokeStyle = this.line;
    pen.fillStyle = this.faint;
    pen.textAlign = "right";
    for (const tick of lowest ? [-axisEnd, 0, axisEnd] : [0, Math.round(axisEnd / 2), axisEnd]) {
      pen.fillText(tick, LEFT - 5, y(tick) + 4);
      drawLine(pen, LEFT, y(tick), width - RIGHT, y(tick));
    }
    for (const tick of tickTimes(start)) drawLine(pen, x(tick), top, x(tick), top + PLOT);
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, top - 2, width - LEFT - RIGHT + 2, PLOT + 4);
    pen.clip();
    pen.lineWidth = 1.5;
    for (let curve = first; curve < first + n; curve++) {
      pen.strokeStyle = pen.fillStyle = this.#colours[curve - first + entry];
      pen.beginPath();
      for (let sample = firstSample; sample < buffer.n; sample++) pen.lineTo(x(buffer.time(sample)), y(buffer.value(sample, curve)));
      pen.stroke();
      if (pointedSample !== null) pen.fillRect(x(buffer.time(pointedSample)) - 2.5, y(buffer.value(pointedSample, curve)) - 2.5, 5, 5);
    }
    pen.strokeStyle = this.faint;
    if (pointedSample !== null) drawLine(pen, x(buffer.time(pointedSample)), top, x(buffer.time(pointedSample)), top + PLOT);
    pen.restore();
  }

  // Shows the values at the pointer in the legend.
  #showValues(buffer, sample, name) {
    const { first, n, entry, title } = this.#plots[name] ?? {};
    setText(this.timeOutput, sample === null ? "Point at a curve to read its values." : `${buffer.time(sample).toFixed(2)} s: ${title}`);
    this.curves.forEach(({ value }, curve) => setText(value, sample !== null && curve >= entry && curve < entry + n ? buffer.value(sample, first + curve - entry) : ""));
  }
}

// The newest samples of a robot, in a fixed size of memory.
class RingBuffer {
  n = 0; // samples so far
  times = new Float64Array(SIZE);
  #values;

  // Takes the names of the robot's sensors.
  constructor(names) {
    this.size = 2 * names.length + 2; // values of a sample: those of all plots
    this.#values = new Int16Array(SIZE * this.size);
  }

  add(time, { proximity, ambient, speed }) {
    const last = this.n && this.times[(this.n - 1) % SIZE];
    if (!this.n || Math.floor(time / SLOT) !== Math.floor(last / SLOT)) this.n++;
    const slot = (this.n - 1) % SIZE;
    this.times[slot] = time;
    this.#values.set([...proximity, ...ambient, ...speed.slice(0, 2)], slot * this.size);
  }

  time(sample) {
    return this.times[sample % SIZE];
  }

  value(sample, curve) {
    return this.#values[(sample % SIZE) * this.size + curve];
  }

  // Returns the first stored sample that is not before a time, or the last one.
  findFirst(time) {
    let sample = Math.max(this.n - SIZE, 0);
    while (sample < this.n - 1 && this.time(sample) < time) sample++;
    return sample;
  }

  findNearest(time) {
    const after = this.findFirst(time);
    const before = Math.max(after - 1, this.n - SIZE, 0);
    return time - this.time(before) < this.time(after) - time ? before : after;
  }
}

const tickTimes = (start) => Array.from({ length: SPAN / 5 + 1 }, (_, tick) => (Math.ceil(start / 5) + tick) * 5).filter((time) => time <= start + SPAN);
const drawLine = (pen, x1, y1, x2, y2) => pen.stroke(new Path2D(`M${x1} ${y1}L${x2} ${y2}`));
