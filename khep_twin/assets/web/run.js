// The running twin, or the robot at a port: begun, paused and ended, and what the page shows of it.

import { keep, post } from "./api.js";
import { Curves } from "./curves.js";
import { Driving } from "./driving.js";
import { Handling } from "./handling.js";
import { LivePlan } from "./live.js";
import { undoKey } from "./model.js";
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

export class Running {
  active = false;
  busy = false;
  asking = false; // for a program or a sensor test to begin
  paused = false;
  robots = [];
  #starts = 0;

  constructor(drawing, model, banner, attempt) {
    Object.assign(this, { drawing, model, banner, attempt });
    this.plan = new LivePlan(drawing);
    this.handling = new Handling(this);
    this.driving = new Driving(this);
    this.panel = new Panel($("#panel"), $("#readings"));
    this.strip = new Strip($("#vision"));
    this.curves = new Curves($("#curves"));
    $("#sensor").append(...SENSORS.map((name) => new Option(name, name)));
    const press = (selector, act, about = selector) => $(selector).addEventListener("click", () => attempt(act, about));
    press("#start", () => this.start(), "run");
    press("#reset", () => this.start(), "run");
    press("#pause", () => this.pause());
    press("#step", () => this.step());
    press("#connect", () => post("connect", { port: $("#device").value }), "run");
    const stem = () => this.logged.log.replace(/^.*\//, "").replace(/\.mcap$/, "");
    press("#keep-log", async () => keep(await post("log", { file: this.logged.log }), `${stem()}.mcap`));
    press("#keep-report", async () => keep(await post("report", { file: this.logged.log }), `${stem()}.html`));
    press("#copy-view", () => navigator.clipboard.writeText($("#view-command").textContent));
    press("#copy-port", () => navigator.clipboard.writeText($("#port").textContent));
    $("#speed").addEventListener("change", () => attempt(() => this.#pace(), "pace"));
    $("#which").addEventListener("change", () => this.#shape());
    model.addEventListener("change", ({ detail }) => {
      if (detail !== "whole") return;
      if (this.active) this.#live();
      this.driving.choices();
    });
    this.#buttons();
  }

  // True while a twin runs, and no robot at a port.
  get twin() {
    return this.active && !this.real;
  }

  // The robots of the twin, each with the places where it has been.
  get travellers() {
    return this.twin ? this.robots.map((robot, index) => ({ ...robot, places: this.plan.places(index) })) : [];
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

  // Starts a twin, if none is running, and what is wanted on it; meanwhile a second click does nothing.
  async begin(act) {
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
    run: (message) => this.driving.ran(message),
    printed: ({ text }) => this.driving.printed(text),
    sensed: ({ warning }) => this.driving.sensed(warning),
    done: () => {
      this.busy = false;
      this.#buttons();
    },
    error: ({ text }) => {
      this.banner(text, "error", {}, "run");
      this.failed?.(text);
    },
    refused: ({ text }) => {
      this.handling.hands.refused();
      this.banner(text, "error", {}, "hand");
    },
    note: ({ text }) => this.banner(text),
    room: (message) => this.handling.room(message),
    ended: () => this.#ended(),
  };

  #cast(message, real) {
    Object.assign(this, { active: true, real, busy: false, robots: message.robots, last: null });
    this.plan.begin(message.robots.length);
    this.curves.clear(message.robots);
    this.handling.hands.clear();
    const chosen = $("#which");
    chosen.replaceChildren(...message.robots.map((robot, index) => new Option(robot.name, index)));
    this.model.select([]);
    if (!real && message.playpen !== this.model.draft.name) this.banner(`The running twin is in ${message.playpen}, not in this drawing: another page has started it.`, "error");
    for (const part of [this.drawing.svg, $("#arena")]) part.classList.toggle("running", !real);
    this.#shape();
    if (!real) this.#live();
    this.driving.choices();
    this.#buttons();
    this.stage?.changed();
  }

  #live() {
    this.plan.draw(this.robots, this.last);
    this.handling.lamps(this.model.list("lamp").length);
  }

  // Chooses the robot that the panel shows.
  show(index) {
    $("#which").value = index;
    this.#shape();
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
    if (this.real) return;
    this.stage?.told(message);
    const between = shown?.host_commands ? `; ${shown.host_commands} commands between those of the program here` : "";
    write($("#host"), shown?.host ? `A host has it open${between}.` : "No host has it open.");
    this.plan.picture(message, this.handling.held, this.stage?.shown);
    this.handling.told(message.lamps);
  }

  #ended() {
    Object.assign(this, { active: false, busy: false, real: false, paused: false, lost: true });
    for (const part of [this.drawing.svg, $("#arena")]) part.classList.remove("running");
    this.plan.end();
    this.drawing.all();
    $("#clock").textContent = "not running";
    $("#logged").hidden = !this.logged?.log;
    $("#view-command").textContent = this.logged?.view ?? "";
    $("#part").value = 0;
    $("#port").textContent = "–";
    $("#host").textContent = "";
    this.driving.choices();
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
    this.handling.hands.dispatchEvent(new Event("change")); // undo is about them, or again about the drawing
  }

  key(event) {
    if (!this.active) return false;
    if (this.handling.held !== undefined && (event.key === "[" || event.key === "]")) return this.handling.turn(event.key === "[" ? 15 : -15);
    const back = undoKey(event);
    if (back !== null && !this.real) return this.attempt(() => (back ? this.handling.hands.undo() : this.handling.hands.redo()), "hand"), true;
    if (event.key === " " && !this.real) return this.attempt(() => this.pause(), "pace"), true;
    if (event.key === "." && !this.real) return this.attempt(() => this.step(), "pace"), true;
    if (event.key === "Escape") return this.attempt(() => post("stop"), "stop"), true;
    return false;
  }
}
