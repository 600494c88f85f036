// Curves of a robot's readings over the last 20 s of its time, drawn at most once per frame and only in view.

import { write } from "./panel.js";

const SPAN = 20; // shown at once [s]
const SLOT = 0.04; // of several samples within it, the last is kept [s]
const SIZE = 512; // samples of a ring: more than SPAN / SLOT
// Values of a sample from `first` on, with the colours of the legend from `entry` on.
const groups = (n) => ({
  proximity: { title: "proximity [counts]", first: 0, n, entry: 0, lowest: 0 },
  light: { title: "light [counts, low is bright]", first: n, n, entry: 0, lowest: 0 },
  speed: { title: "speeds of the wheels [pulses/10 ms]", first: 2 * n, n: 2, entry: n, lowest: -1 },
});
const [LEFT, RIGHT, TITLE, PLOT, HEIGHT, FOOT] = [38, 8, 17, 76, 101, 22]; // [px]

// The newest samples of a robot, in memory that does not grow.
class Ring {
  n = 0; // samples so far
  times = new Float64Array(SIZE);
  #values;

  // Takes the names of the robot's sensors.
  constructor(names) {
    this.size = 2 * names.length + 2; // values of a sample: those of all groups
    this.#values = new Int16Array(SIZE * this.size);
  }

  add(time, { proximity, ambient, speed }) {
    const last = this.n && this.times[(this.n - 1) % SIZE];
    if (!this.n || Math.floor(time / SLOT) !== Math.floor(last / SLOT)) this.n++;
    const at = (this.n - 1) % SIZE;
    this.times[at] = time;
    this.#values.set([...proximity, ...ambient, ...speed.slice(0, 2)], at * this.size);
  }

  time(sample) {
    return this.times[sample % SIZE];
  }

  value(sample, curve) {
    return this.#values[(sample % SIZE) * this.size + curve];
  }

  // The first sample that is kept and not before a time, or the last one.
  from(time) {
    let sample = Math.max(this.n - SIZE, 0);
    while (sample < this.n - 1 && this.time(sample) < time) sample++;
    return sample;
  }

  nearest(time) {
    const after = this.from(time);
    const before = Math.max(after - 1, this.n - SIZE, 0);
    return time - this.time(before) < this.time(after) - time ? before : after;
  }
}

export class Curves {
  #rings = [new Ring([])];
  #robots = [];
  #named = {};
  #groups = groups(0);
  #which = 0;
  #seen = false;
  #pending = 0;
  #pointer = null; // where it is over the canvas [px]
  #full = {};
  #colours = [];

  // `root` has a canvas, a box for each group, a list for the legend and an output for the time at the pointer.
  constructor(root) {
    Object.assign(this, { root, canvas: root.querySelector("canvas"), list: root.querySelector("ul"), at: root.querySelector("output") });
    this.pen = this.canvas.getContext("2d");
    this.boxes = Object.fromEntries([...root.querySelectorAll("input")].map((box) => [box.value, box]));
    for (const box of Object.values(this.boxes)) box.addEventListener("change", () => this.#soon());
    for (const kind of ["pointermove", "pointerdown", "pointerleave"])
      this.canvas.addEventListener(kind, (event) => {
        this.#pointer = kind === "pointerleave" ? null : [event.offsetX, event.offsetY];
        this.#soon();
      });
    new IntersectionObserver((entries) => {
      this.#seen = entries.at(-1).isIntersecting;
      this.#soon();
    }).observe(root);
    new ResizeObserver(() => this.#soon()).observe(root);
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.dark.addEventListener("change", () => this.curves && this.#paint());
  }

  // The colours of sensors and wheels by name.
  limits(colours) {
    this.#named = colours;
  }

  #legend({ names, bars }) {
    const { sensors, wheels } = this.#named;
    this.#groups = groups(names.length);
    this.#full = Object.fromEntries(Object.entries(bars).map(([name, { full }]) => [name, full]));
    const wheel = Object.entries(wheels).map(([side, colour]) => [`${side} wheel`, colour]);
    this.curves = [...names.map((name) => [name, sensors[name]]), ...wheel].map(([name, colour]) => {
      const [entry, chip, value] = ["li", "i", "b"].map((tag) => document.createElement(tag));
      entry.append(chip, name, value);
      return { colour, entry, chip, value };
    });
    this.list.replaceChildren(...this.curves.map(({ entry }) => entry));
    this.#paint();
  }

  // A new run, with these robots; their bars' full values are on the axes at least.
  clear(robots) {
    this.#robots = robots;
    this.#rings = robots.map(({ names }) => new Ring(names));
    this.root.hidden = false;
    this.show(0);
  }

  show(which) {
    this.#which = which;
    this.#legend(this.#robots[which]);
  }

  read({ time, robots }) {
    robots.forEach((reading, index) => this.#rings[index]?.add(time, reading));
    this.#soon();
  }

  // The colours are made for black; on white they are darker.
  #paint() {
    const part = this.dark.matches ? 1 : 0.68;
    this.#colours = this.curves.map(({ colour }) => `rgb(${colour.map((each) => Math.round(each * part)).join(" ")})`);
    this.curves.forEach(({ chip }, curve) => (chip.style.background = this.#colours[curve]));
    const style = getComputedStyle(this.canvas);
    [this.ink, this.faint, this.line] = ["--ink", "--faint", "--line"].map((name) => style.getPropertyValue(name));
    this.#soon();
  }

  #soon() {
    if (this.#seen && this.curves) this.#pending ||= requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    this.#pending = 0;
    const { canvas, pen } = this;
    const shown = Object.keys(this.#groups).filter((name) => this.boxes[name].checked);
    this.curves.forEach(({ entry }, curve) => (entry.hidden = !shown.some((name) => (name === "speed") === curve >= this.#groups.speed.entry)));
    canvas.hidden = !shown.length;
    if (!canvas.clientWidth) return;
    const [width, height, scale] = [canvas.clientWidth, shown.length * HEIGHT + FOOT, devicePixelRatio];
    const pixels = [Math.round(width * scale), Math.round(height * scale)];
    if (canvas.width !== pixels[0] || canvas.height !== pixels[1]) [canvas.width, canvas.height] = pixels;
    canvas.style.height = `${height}px`;
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "11px system-ui, sans-serif";
    const ring = this.#rings[this.#which];
    const begin = ring.n ? Math.max(ring.time(ring.n - 1) - SPAN, ring.time(ring.from(-Infinity))) : 0;
    const x = (time) => LEFT + ((time - begin) / SPAN) * (width - LEFT - RIGHT);
    const pointed = this.#pointer && ring.n ? shown[Math.min(Math.floor(this.#pointer[1] / HEIGHT), shown.length - 1)] : undefined;
    const under = pointed ? ring.nearest(begin + ((this.#pointer[0] - LEFT) / (width - LEFT - RIGHT)) * SPAN) : null;
    shown.forEach((name, index) => this.#plot(name, index * HEIGHT + TITLE, { ring, begin, x, under, width }));
    pen.fillStyle = this.faint;
    pen.textAlign = "center";
    for (const tick of ticks(begin)) pen.fillText(tick, x(tick), height - 17);
    pen.fillText("time [s]", x(begin + SPAN / 2), height - 4);
    this.#tell(ring, under, pointed);
  }

  // The axes and curves of a group, from `top` on.
  #plot(name, top, { ring, begin, x, under, width }) {
    const { pen } = this;
    const { title, first, n, entry, lowest } = this.#groups[name];
    const from = Math.max(ring.from(begin) - 1, ring.n - SIZE, 0);
    let most = 0;
    for (let sample = from; sample < ring.n; sample++) for (let curve = first; curve < first + n; curve++) most = Math.max(most, Math.abs(ring.value(sample, curve)));
    const high = Math.max(this.#full[name], Math.ceil(most / 10) * 10 * (most > this.#full[name]));
    const y = (value) => top + PLOT * (1 - (value / high - lowest) / (1 - lowest));
    pen.fillStyle = this.ink;
    pen.textAlign = "left";
    pen.fillText(title, LEFT, top - 5);
    pen.lineWidth = 1;
    pen.strokeStyle = this.line;
    pen.fillStyle = this.faint;
    pen.textAlign = "right";
    for (const tick of lowest ? [-high, 0, high] : [0, Math.round(high / 2), high]) {
      pen.fillText(tick, LEFT - 5, y(tick) + 4);
      segment(pen, LEFT, y(tick), width - RIGHT, y(tick));
    }
    for (const tick of ticks(begin)) segment(pen, x(tick), top, x(tick), top + PLOT);
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, top - 2, width - LEFT - RIGHT + 2, PLOT + 4);
    pen.clip();
    pen.lineWidth = 1.5;
    for (let curve = first; curve < first + n; curve++) {
      pen.strokeStyle = pen.fillStyle = this.#colours[curve - first + entry];
      pen.beginPath();
      for (let sample = from; sample < ring.n; sample++) pen.lineTo(x(ring.time(sample)), y(ring.value(sample, curve)));
      pen.stroke();
      if (under !== null) pen.fillRect(x(ring.time(under)) - 2.5, y(ring.value(under, curve)) - 2.5, 5, 5);
    }
    pen.strokeStyle = this.faint;
    if (under !== null) segment(pen, x(ring.time(under)), top, x(ring.time(under)), top + PLOT);
    pen.restore();
  }

  // The values at the pointer stand in the legend.
  #tell(ring, sample, name) {
    const { first, n, entry, title } = this.#groups[name] ?? {};
    write(this.at, sample === null ? "Point at a curve to read its values." : `${ring.time(sample).toFixed(2)} s: ${title}`);
    this.curves.forEach(({ value }, curve) => write(value, sample !== null && curve >= entry && curve < entry + n ? ring.value(sample, first + curve - entry) : ""));
  }
}

const ticks = (begin) => Array.from({ length: SPAN / 5 + 1 }, (_, tick) => (Math.ceil(begin / 5) + tick) * 5).filter((tick) => tick <= begin + SPAN);
const segment = (pen, x1, y1, x2, y2) => pen.stroke(new Path2D(`M${x1} ${y1}L${x2} ${y2}`));
