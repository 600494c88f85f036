// The running twin in the drawing, or the robot at a port, and moves of robots and lamps by the user.

import { keep, post } from "./api.js";
import { Curves } from "./curves.js";
import { closed, make, place } from "./drawing.js";
import { Hands } from "./hands.js";
import { angle, OBJECTS, tidy, undoKey } from "./model.js";
import { Panel, SENSORS, Strip, write } from "./panel.js";

const $ = (selector) => document.querySelector(selector);
const number = (selector) => ($(selector).value === "" ? null : $(selector).valueAsNumber);

// When a button can be pressed, by its data-when.
const WHEN = {
  ended: ({ active }) => !active,
  running: ({ active }) => active,
  twin: ({ twin }) => twin,
  "no-twin": ({ twin }) => !twin,
  idle: ({ busy, asking }) => !busy && !asking,
};

// Path of a robot so far: of many short paths only the last is drawn anew.
class Trail {
  node = make("g");
  places = []; // the newest
  #last = null;
  #path = null;
  #points = [];

  add(x, y) {
    const way = this.#last ? Math.hypot(this.#last[0] - x, this.#last[1] - y) : Infinity;
    if (way <= 3) return;
    // After a jump, when the user has moved the robot, a new path begins.
    if (way > 150 || this.#points.length >= 60) {
      this.#points = way > 150 ? [] : [this.#last];
      this.#path = make("path", { class: "trail" });
      this.node.append(this.#path);
      if (this.node.childElementCount > 25) this.node.firstChild.remove();
    }
    this.#last = [x, y];
    this.#points.push(this.#last);
    if (this.places.push(this.#last) > 1500) this.places.shift();
    this.#path.setAttribute("d", `M${this.#points.map((point) => point.join(" ")).join("L")}`);
  }
}

export class Running {
  active = false;
  busy = false;
  asking = false; // for a program or a sensor test to begin
  paused = false;
  robots = [];
  hands = new Hands();
  #held = null;
  #trails = [];
  #starts = 0;
  #offered = [];

  constructor(drawing, model, banner, attempt) {
    Object.assign(this, { drawing, model, banner, attempt });
    this.panel = new Panel($("#panel"), $("#readings"));
    this.strip = new Strip($("#vision"));
    this.curves = new Curves($("#curves"));
    $("#sensor").append(...SENSORS.map((name) => new Option(name, name)));
    const press = (selector, act, about = selector) => $(selector).addEventListener("click", () => attempt(act, about));
    press("#start", () => this.start(), "run");
    press("#reset", () => this.start(), "run");
    press("#pause", () => this.pause());
    press("#step", () => this.step());
    press("#run", () => this.run(), "run");
    press("#gather", () => this.#begin(() => this.#gather()), "run");
    press("#display", () => this.#figure(), "figure");
    press("#save-sensed", async () => {
      await post("save-sensed", { file: $("#sensed-file").value });
      this.banner(`Saved as ${$("#sensed-file").value}.`);
    });
    press("#connect", () => post("connect", { port: $("#device").value }), "run");
    const stem = () => this.logged.log.replace(/^.*\//, "").replace(/\.mcap$/, "");
    press("#keep-log", async () => keep(await post("log", { file: this.logged.log }), `${stem()}.mcap`));
    press("#keep-report", async () => keep(await post("report", { file: this.logged.log }), `${stem()}.html`));
    press("#copy-view", () => navigator.clipboard.writeText($("#view-command").textContent));
    press("#copy-port", () => navigator.clipboard.writeText($("#port").textContent));
    press("#put", () => this.#put(this.which, number("#put-x"), number("#put-y"), number("#put-h")), "hand");
    $("#speed").addEventListener("change", () => attempt(() => this.#pace(), "pace"));
    $("#which").addEventListener("change", () => this.#shape());
    model.addEventListener("change", ({ detail }) => {
      if (detail !== "whole") return;
      if (this.active) this.#live();
      this.#choices();
    });
    this.#buttons();
  }

  // True while a twin runs, and no robot at a port.
  get twin() {
    return this.active && !this.real;
  }

  // The robots of the twin, each with the places where it has been.
  get travellers() {
    return this.twin ? this.robots.map((robot, index) => ({ ...robot, places: this.#trails[index].places })) : [];
  }

  get which() {
    return Math.max(+$("#which").value || 0, 0);
  }

  async start() {
    this.#starts++;
    this.paused = this.lost = false;
    $("#logged").hidden = true;
    this.logged = await post("start", { file: this.model.file, version: this.model.document.version, draft: this.model.draft, seed: number("#seed") ?? 0, noise: $("#noise").checked, log: $("#log").value || null, speed: +$("#speed").value });
  }

  async pause() {
    this.paused = !this.paused;
    await this.#pace();
    this.#buttons();
  }

  async step() {
    if (!this.paused) await this.pause();
    await post("step");
  }

  async #pace() {
    if (this.active && !this.real) await post("pace", { speed: +$("#speed").value, paused: this.paused });
  }

  // Offers programs, one for each robot; `renew` replaces a list that has changed.
  offer(names, renew) {
    Object.assign(this, { renew });
    this.#offered = names;
    this.#choices();
  }

  #choices() {
    const count = Math.max(this.active ? this.robots.length : this.model.list("robot").length, 1);
    $("#first").textContent = count > 1 ? "robot 1" : "program";
    const others = $("#others");
    while (others.childElementCount > count - 1) others.lastChild.remove();
    while (others.childElementCount < count - 1) {
      const label = Object.assign(document.createElement("label"), { className: "wide", textContent: `robot ${others.childElementCount + 2} ` });
      label.append(document.createElement("select"));
      others.append(label);
    }
    const choices = this.#offered.map((name) => [name, name]);
    if (count > 1) choices.push(["none: it stands", ""]);
    for (const list of this.#programs) this.renew?.(list, choices.map(([text, value]) => new Option(text, value)));
  }

  // Chooses a program for the first robot, if no robot has it.
  choose(file) {
    if (!this.#offered.includes(file)) this.#offered.push(file);
    this.#choices();
    if (!this.#programs.some(({ value }) => value === file)) $("#controller").value = file;
  }

  // The lists of programs, the first robot's first.
  get #programs() {
    return [$("#controller"), ...document.querySelectorAll("#others select")];
  }

  run() {
    if (this.busy) throw new Error("A program is running: Stop ends it, within five seconds.");
    return this.#begin(() => this.#run());
  }

  // Starts a twin, if none is running, and what is wanted on it; meanwhile a second click does nothing.
  async #begin(act) {
    if (this.asking) return;
    this.asking = true;
    this.#buttons();
    try {
      if (!this.active) await this.start();
      if (!(await this.#there())) return;
      await act();
      this.busy = true;
    } finally {
      this.asking = false;
      this.#buttons();
    }
  }

  async #run() {
    $('[data-tab="run"]').click();
    $("#runs-done tbody").replaceChildren();
    $("#printed").textContent = "";
    $("#printed").hidden = true;
    $("#part").value = 0;
    await post("run", { controllers: this.#programs.map(({ value }) => value), cycles: number("#cycles"), seconds: number("#seconds"), runs: number("#runs") ?? 1, pause: number("#between") ?? 0, folder: $("#keep").value || null });
  }

  async #gather() {
    await post("sense", { what: $("#what").value, motion: $("#motion").value, amount: number("#amount"), speed: number("#sense-speed"), acceleration: number("#sense-acceleration"), return: $("#return").checked, text: $("#text").value });
  }

  async #figure() {
    const blob = await post("figure", { sensor: $("#sensor").value || null, y_min: number("#y-min") ?? 0, grid: $("#with-grid").checked });
    const picture = $("#figure");
    URL.revokeObjectURL(picture.src);
    picture.src = URL.createObjectURL(blob);
    picture.alt = "Counts of the sensors over the path";
    picture.hidden = false;
  }

  // Waits until the twin has started, which takes long in a large playpen, or has failed with a shown reason.
  async #there() {
    const starts = this.#starts; // a later start is waited for by its own button
    for (let tries = 0; tries < 300 && starts === this.#starts && !this.active && !this.lost; tries++) await new Promise((done) => setTimeout(done, 100));
    return this.active && starts === this.#starts;
  }

  // What it does about each kind of message (khep_twin/web/messages.py).
  hears = {
    twin: (message) => this.#cast(message, false),
    robot: (message) => this.#cast(message, true),
    picture: (message) => this.#picture(message),
    run: (message) => this.#ran(message),
    printed: ({ text }) => this.#printed(text),
    sensed: ({ warning }) => {
      const box = $("#sensed-warning");
      box.textContent = warning;
      box.hidden = !warning;
      return this.attempt(() => this.#figure(), "figure");
    },
    done: () => {
      this.busy = false;
      this.#buttons();
    },
    error: ({ text }) => {
      this.banner(text, "error", {}, "run");
      this.failed?.(text);
    },
    refused: ({ text }) => {
      this.hands.refused();
      this.banner(text, "error", {}, "hand");
    },
    note: ({ text }) => this.banner(text),
    room: (message) => this.#room(message),
    ended: () => this.#ended(),
  };

  #cast(message, real) {
    Object.assign(this, { active: true, real, busy: false, robots: message.robots, last: null });
    this.#trails = message.robots.map(() => new Trail());
    this.curves.clear(message.robots.length);
    this.hands.clear();
    const chosen = $("#which");
    chosen.replaceChildren(...message.robots.map((robot, index) => new Option(robot.name, index)));
    this.model.select([]);
    if (!real && message.playpen !== this.model.draft.name) this.banner(`The running twin is in ${message.playpen}, not in this drawing: another page has started it.`, "error");
    for (const part of [this.drawing.svg, $("#arena")]) part.classList.toggle("running", !real);
    this.#shape();
    if (!real) this.#live();
    this.#choices();
    this.#buttons();
    this.stage?.changed();
  }

  #live() {
    const { drawing } = this;
    this.nodes = this.robots.map((robot, index) => {
      const node = drawing.robot(null, robot.turrets, robot);
      const rays = robot.sensors.map(([x, y, heading]) => {
        const fan = make("path", { class: "ray", d: "M0 0L40 -14A42 42 0 0 1 40 14Z", transform: `translate(${x} ${y}) rotate(${heading})`, opacity: 0.06 });
        node.prepend(fan);
        return fan;
      });
      node.classList.add("live", "thing");
      node.dataset.live = index;
      if (this.last) place(node, this.last.robots[index]);
      return { node, rays, turrets: node.querySelectorAll(".turret") };
    });
    drawing.live.replaceChildren(...this.#trails.map(({ node }) => node), ...this.nodes.map(({ node }) => node));
    $("#switches").replaceChildren(
      ...this.model.list("lamp").map((_, index) => {
        const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: true });
        box.addEventListener("change", () => this.#switch(index, box.checked));
        const label = document.createElement("label");
        label.append(box, ` lamp ${index + 1}`);
        return label;
      }),
    );
  }

  #shape() {
    const robot = this.robots[this.which];
    if (!robot) return;
    this.panel.shape(robot);
    this.strip.clear();
    this.curves.show(this.which);
    $("#port").textContent = robot.port;
  }

  #picture(message) {
    if (!this.active) return;
    const shown = message.robots[this.which];
    if (!this.last && message.speed !== undefined) $("#speed").value = message.speed;
    this.last = message;
    // Another page may have paused it, or this one was loaded meanwhile.
    const [busy, paused] = [message.busy === true, message.paused === true];
    if (busy !== this.busy || paused !== this.paused) {
      Object.assign(this, { busy, paused });
      this.#buttons();
    }
    if (shown && this.panel.near) this.panel.read(shown);
    if (shown) this.strip.read(shown, message.time);
    this.curves.read(message);
    if (message.part !== $("#part").value) $("#part").value = message.part;
    write($("#clock"), `${message.time.toFixed(2)} s${message.paused ? ", paused" : ""}${message.busy ? ", driven from here" : ""}`);
    if (this.real || !this.nodes) return;
    this.stage?.told(message);
    const between = shown?.host_commands ? `; ${shown.host_commands} commands between those of the program here` : "";
    write($("#host"), shown?.host ? `A host has it open${between}.` : "No host has it open.");
    const hidden = this.stage?.shown; // the plan needs no work then
    message.robots.forEach((robot, index) => {
      const { node, rays, turrets } = this.nodes[index] ?? {};
      if (!node) return;
      this.#trails[index].add(robot.x_mm, robot.y_mm);
      if (hidden) return;
      if (this.#held?.index !== index) place(node, robot);
      robot.turrets.forEach((points, part) => turrets[part]?.setAttribute("d", closed(points)));
      robot.proximity.forEach((count, sensor) => rays[sensor]?.setAttribute("opacity", 0.05 + (0.6 * count) / 1023));
    });
    message.lamps.forEach(({ power_w }, index) => {
      this.drawing.nodes.get(`lamp:${index}`)?.classList.toggle("off", power_w === 0);
      const box = $(`#switches label:nth-child(${index + 1}) input`);
      if (box && box !== document.activeElement) box.checked = !message.lamps[index].off;
    });
    for (const kind of Object.keys(OBJECTS))
      for (const [index, [x_mm, y_mm, angle_deg]] of Object.entries(message.objects[kind])) {
        const node = this.drawing.nodes.get(`${kind}:${index}`);
        if (node) place(node, { x_mm, y_mm, angle_deg });
      }
  }

  #ran(message) {
    const { fitness, distance_m } = message.metrics;
    const row = document.createElement("tr");
    const whose = this.robots.length > 1 ? `robot ${message.robot + 1}: ` : "";
    const cells = [`${whose}${message.number}${message.stopped ? ", stopped" : ""}`, message.cycles, message.seconds.toFixed(1), fitness?.toPrecision(3) ?? "–", distance_m?.toPrecision(3) ?? "–"];
    row.append(...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
    $("#runs-done tbody").append(row);
  }

  // The end of the controller's output; it scrolls along unless the user has scrolled up.
  #printed(text) {
    const box = $("#printed");
    const along = box.scrollTop + box.clientHeight >= box.scrollHeight - 4;
    box.hidden = false;
    box.textContent = (box.textContent + text).slice(-20000);
    if (along) box.scrollTop = box.scrollHeight;
  }

  #ended() {
    Object.assign(this, { active: false, busy: false, real: false, paused: false, nodes: null, lost: true });
    for (const part of [this.drawing.svg, $("#arena")]) part.classList.remove("running");
    this.drawing.live.replaceChildren();
    this.drawing.all();
    $("#clock").textContent = "not running";
    $("#logged").hidden = !this.logged?.log;
    $("#view-command").textContent = this.logged?.view ?? "";
    $("#part").value = 0;
    $("#port").textContent = "–";
    $("#host").textContent = "";
    this.#choices();
    this.#buttons();
    this.stage?.changed();
  }

  #buttons() {
    for (const button of document.querySelectorAll("[data-when]")) button.disabled = !WHEN[button.dataset.when](this);
    $("#pause").textContent = this.paused ? "Resume" : "Pause";
    document.body.classList.toggle("running", this.active);
    // The twin was made from the drawing, which does not change.
    for (const id of ["#tools", "#tab-object", "#tab-playpen"]) $(id).inert = this.twin;
    if (this.stage?.shown) $("#tools").inert = true;
    this.hands.dispatchEvent(new Event("change")); // undo is about them, or again about the drawing
  }

  // Puts a robot to a place; undo puts it back to where it was lifted from, or else to where it is now.
  #put(robot, x_mm, y_mm, heading_deg, from = this.last?.robots[robot]) {
    const to = ({ x_mm, y_mm, heading_deg }) => ["put", { robot, x_mm, y_mm, heading_deg }];
    return this.hands.do(to({ x_mm, y_mm, heading_deg }), from && to(from));
  }

  #switch(lamp, on) {
    return this.attempt(() => this.hands.do(["switch", { lamp, on }], ["switch", { lamp, on: !on }]), "hand");
  }

  // Lifts a robot or puts it down; a click on a lamp switches it. Returns whether the pointer hit one of them.
  down(event, at, target) {
    if (this.real || !this.last || event.button !== 0) return false;
    const live = target?.closest?.(".live");
    const lamp = target?.dataset.id?.match(/^lamp:(\d+)$/);
    if (lamp) {
      const off = this.last?.lamps[+lamp[1]]?.off;
      this.#switch(+lamp[1], off === true);
      return true;
    }
    if (!live) return false;
    const index = +live.dataset.live;
    const { x_mm, y_mm, heading_deg } = this.last.robots[index];
    this.#held = { index, at, from: [x_mm, y_mm], lifted: this.last.robots[index], x_mm, y_mm, heading_deg, node: live };
    live.classList.add("held");
    $("#which").value = index;
    this.#shape();
    return true;
  }

  move(_, at) {
    const held = this.#held;
    if (!held || held.down) return;
    held.x_mm = held.from[0] + at[0] - held.at[0];
    held.y_mm = held.from[1] + at[1] - held.at[1];
    place(held.node, held);
    this.#ask(held);
  }

  // Asks if a held robot has room at its position: one question at a time.
  #ask(held) {
    held.moved = true;
    if (held.asked) return;
    Object.assign(held, { asked: true, moved: false });
    this.attempt(() => post("room", { robot: held.index, x_mm: held.x_mm, y_mm: held.y_mm }), "room");
  }

  #room({ robot, reason }) {
    const held = this.#held;
    if (held?.index !== robot || !held.asked) return;
    held.asked = false;
    held.node.classList.toggle("bad", reason !== "");
    this.drawing.reasons(reason ? [[[held.x_mm, held.y_mm], reason]] : []);
    if (held.moved && !held.down) this.#ask(held);
  }

  turn(degrees) {
    if (!this.#held || this.#held.down) return false;
    this.#held.heading_deg += degrees;
    place(this.#held.node, this.#held);
    return true;
  }

  up() {
    const held = this.#held;
    if (!held || held.down) return;
    held.down = true; // and stays where it was let go until the twin has answered
    held.node.classList.remove("held");
    const { index } = held;
    const [x_mm, y_mm, heading_deg] = [tidy(held.x_mm), tidy(held.y_mm), angle(held.heading_deg)];
    this.attempt(async () => {
      try {
        if (Math.hypot(x_mm - held.from[0], y_mm - held.from[1]) > 1 || heading_deg !== this.last.robots[index].heading_deg)
          await this.#put(index, x_mm, y_mm, heading_deg, held.lifted);
      } finally {
        held.node.classList.remove("bad");
        this.drawing.reasons([]);
        this.#held = null;
      }
    }, "hand");
  }

  key(event) {
    if (!this.active) return false;
    if (this.#held && (event.key === "[" || event.key === "]")) return this.turn(event.key === "[" ? 15 : -15);
    const back = undoKey(event);
    if (back !== null && !this.real) return this.attempt(() => (back ? this.hands.undo() : this.hands.redo()), "hand"), true;
    if (event.key === " " && !this.real) return this.attempt(() => this.pause(), "pace"), true;
    if (event.key === "." && !this.real) return this.attempt(() => this.step(), "pace"), true;
    if (event.key === "Escape") return this.attempt(() => post("stop"), "stop"), true;
    return false;
  }
}
