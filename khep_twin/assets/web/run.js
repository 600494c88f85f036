// The running twin, or the robot at a port: started, paused and ended, and its state on the page.

import { download, post } from "./api.js";
import { Curves } from "./curves.js";
import { Driving } from "./driving.js";
import { Handling } from "./handling.js";
import { LivePlan } from "./live.js";
import { DEFAULTS, readUndoKey } from "./model.js";
import { $, appendOutput, readNumber, setText } from "./page.js";
import { Panel, Strip } from "./panel.js";

// States in which a button is enabled, by its data-when.
const WHEN = {
  ended: ({ isActive }) => !isActive,
  running: ({ isActive }) => isActive,
  twin: ({ hasTwin }) => hasTwin,
  "no-twin": ({ hasTwin }) => !hasTwin,
  idle: ({ isBusy, isStarting }) => !isBusy && !isStarting,
};

export class Running {
  isActive = false; // a twin runs, or a robot at a port is connected
  isBusy = false; // a program or a sensor test runs
  isStarting = false; // one of them has been requested
  isPaused = false;
  robots = [];
  #startCount = 0;

  constructor(drawing, model, banner, attempt) {
    Object.assign(this, { drawing, model, banner, attempt });
    this.plan = new LivePlan(drawing);
    this.handling = new Handling(this);
    this.driving = new Driving(this);
    this.panel = new Panel($("#panel"), $("#readings"), $("#bars"));
    this.strip = new Strip($("#vision"));
    this.curves = new Curves($("#curves"));
    const press = (selector, act, about = selector) => $(selector).addEventListener("click", () => attempt(act, about));
    press("#start", () => this.start(), "run");
    press("#reset", () => this.start(), "run");
    press("#pause", () => this.pause());
    press("#step", () => this.step());
    press("#connect", () => post("connect", { port: $("#device").value }), "run");
    const logStem = () => this.startReply.log.replace(/^.*\//, "").replace(/\.mcap$/, "");
    press("#keep-log", async () => download(await post("log", { file: this.startReply.log }), `${logStem()}.mcap`));
    press("#keep-report", async () => download(await post("report", { file: this.startReply.log }), `${logStem()}.html`));
    press("#keep-page", async () => download(await post("page", { file: this.startReply.log }), `${logStem()}.html`));
    press("#copy-view", () => navigator.clipboard.writeText($("#view-command").textContent));
    press("#copy-port", () => navigator.clipboard.writeText($("#port").textContent));
    $("#speed").addEventListener("change", () => attempt(() => this.#setPace(), "pace"));
    $("#which").addEventListener("change", () => this.#showRobot());
    model.addEventListener("change", ({ detail }) => {
      if (detail !== "draft") return;
      if (this.isActive) this.#drawLive();
      this.#updateModels();
    });
    this.#updateButtons();
  }

  // True while a twin runs; false for a robot at a port.
  get hasTwin() {
    return this.isActive && !this.isRealRobot;
  }

  // The robots of the twin, each with the points of its path.
  get robotPaths() {
    return this.hasTwin ? this.robots.map((robot, index) => ({ ...robot, path: this.plan.path(index) })) : [];
  }

  // The robots that run, or the models of those in the drawing, at least one.
  get shapes() {
    const [{ shapes }, parts] = [this.drawing, this.model.partsOf("robot")];
    return this.isActive ? this.robots : (parts.length ? parts : [DEFAULTS.robot]).map(({ model }) => shapes[model] ?? shapes[DEFAULTS.robot.model]);
  }

  get selectedIndex() {
    return Math.max(+$("#which").value || 0, 0);
  }

  async start() {
    this.#startCount++;
    this.isPaused = this.hasEnded = false;
    $("#logged").hidden = true;
    this.startReply = await post("start", { file: this.model.file, version: this.model.document.version, draft: this.model.draft, seed: readNumber("#seed") ?? 0, noise: $("#noise").checked, log: $("#log").value || null, speed: +$("#speed").value });
  }

  async pause() {
    this.isPaused = !this.isPaused;
    await this.#setPace();
    this.#updateButtons();
  }

  async step() {
    if (!this.isPaused) await this.pause();
    await post("step");
  }

  async #setPace() {
    if (this.isActive && !this.isRealRobot) await post("pace", { speed: +$("#speed").value, paused: this.isPaused });
  }

  // Starts a job, and before it a twin if none is running; meanwhile a second click does nothing.
  async startJob(act) {
    if (this.isStarting) return;
    this.isStarting = true;
    this.#updateButtons();
    try {
      if (!this.isActive) await this.start();
      if (!(await this.#waitForStart())) return;
      await act();
      this.isBusy = true;
    } finally {
      this.isStarting = false;
      this.#updateButtons();
    }
  }

  // Waits until the twin has started, which takes long in a large playpen, or has failed with a reason in a banner.
  async #waitForStart() {
    const startCount = this.#startCount; // its change is a later start, for which another button waits
    for (let attempts = 0; attempts < 300 && startCount === this.#startCount && !this.isActive && !this.hasEnded; attempts++) await new Promise((resolve) => setTimeout(resolve, 100));
    return this.isActive && startCount === this.#startCount;
  }

  // Handlers of messages by their kind (khep_twin/web/messages.py).
  messageHandlers = {
    twin: (message) => this.#showRobots(message, false),
    robot: (message) => this.#showRobots(message, true),
    paths: ({ paths }) => this.plan.addPaths(paths),
    picture: (message) => this.#showPicture(message),
    run: (message) => this.driving.addRun(message),
    printed: ({ text }) => appendOutput($("#printed"), text),
    sensed: ({ warning }) => this.driving.showSensorTest(warning),
    done: () => {
      this.isBusy = false;
      this.#updateButtons();
    },
    error: ({ text }) => {
      this.banner(text, "error", {}, "run");
      this.onError?.(text);
    },
    refused: ({ text }) => {
      this.handling.history.revert();
      this.banner(text, "error", {}, "hand");
    },
    note: ({ text }) => this.banner(text),
    room: (message) => this.handling.showRoom(message),
    ended: () => this.#showEnd(),
  };

  #showRobots(message, isRealRobot) {
    Object.assign(this, { isActive: true, isRealRobot, isBusy: false, robots: message.robots, lastPicture: null });
    this.plan.clear(message.robots.length);
    this.curves.clear(message.robots);
    this.handling.history.clear();
    $("#which").replaceChildren(...message.robots.map(({ title }, index) => new Option(`${index + 1}: ${title}`, index)));
    this.model.select([]);
    if (!isRealRobot && message.playpen !== this.model.draft.name) this.banner(`The running twin is in ${message.playpen}, not in this drawing: another page has started it.`, "error");
    for (const element of [this.drawing.svg, $("#arena")]) element.classList.toggle("running", !isRealRobot);
    this.#showRobot();
    if (!isRealRobot) this.#drawLive();
    this.#updateModels();
    this.#updateButtons();
    this.stage?.reload();
  }

  // Shows the programs of the robots, and the sensors of the first one, which a sensor test drives.
  #updateModels() {
    this.driving.updateLists();
    const [shape] = this.shapes;
    this.driving.updateOptions?.($("#sensor"), ["all", ...shape.names].map((name, index) => new Option(name, index ? name : "")));
    if (!this.lastPicture) this.panel.drawRobot(shape);
  }

  #drawLive() {
    this.plan.drawRobots(this.robots, this.lastPicture);
    this.handling.createSwitches(this.model.partsOf("lamp").length);
  }

  // Selects the robot that the panel shows.
  selectRobot(index) {
    $("#which").value = index;
    this.#showRobot();
  }

  #showRobot() {
    const robot = this.robots[this.selectedIndex];
    if (!robot) return;
    this.panel.drawRobot(robot);
    this.strip.clear();
    this.curves.selectRobot(this.selectedIndex);
    $("#port").textContent = robot.port;
  }

  #showPicture(message) {
    if (!this.isActive) return;
    const readings = message.robots[this.selectedIndex];
    if (!this.lastPicture && message.speed !== undefined) $("#speed").value = message.speed;
    this.lastPicture = message;
    // Another page may have paused it, or this one was loaded meanwhile.
    const [isBusy, isPaused] = [message.busy === true, message.paused === true];
    if (isBusy !== this.isBusy || isPaused !== this.isPaused) {
      Object.assign(this, { isBusy, isPaused });
      this.#updateButtons();
    }
    if (readings && this.panel.proximityBars) this.panel.showReadings(readings);
    if (readings) this.strip.add(readings, message.time);
    this.curves.add(message);
    if (message.part !== $("#part").value) $("#part").value = message.part;
    setText($("#clock"), `${message.time.toFixed(2)} s${message.paused ? ", paused" : ""}${message.busy ? ", driven from here" : ""}`);
    if (this.isRealRobot) return;
    this.stage?.showPicture(message);
    const commands = readings?.host_commands ? `; ${readings.host_commands} commands between those of the program here` : "";
    setText($("#host"), readings?.host ? `A host has it open${commands}.` : "No host has it open.");
    this.plan.showPicture(message, this.handling.liftedIndex, this.stage?.isShown);
    this.handling.updateSwitches(message.lamps);
  }

  #showEnd() {
    Object.assign(this, { isActive: false, isBusy: false, isRealRobot: false, isPaused: false, hasEnded: true });
    for (const element of [this.drawing.svg, $("#arena")]) element.classList.remove("running");
    this.plan.end();
    this.drawing.drawAll();
    $("#clock").textContent = "not running";
    $("#logged").hidden = !this.startReply?.log;
    $("#view-command").textContent = this.startReply?.view ?? "";
    $("#part").value = 0;
    $("#port").textContent = "–";
    $("#host").textContent = "";
    this.#updateModels();
    this.#updateButtons();
    this.stage?.reload();
  }

  #updateButtons() {
    for (const button of document.querySelectorAll("[data-when]")) button.disabled = !WHEN[button.dataset.when](this);
    $("#pause").textContent = this.isPaused ? "Resume" : "Pause";
    document.body.classList.toggle("running", this.isActive);
    // The twin was made from the drawing, which does not change.
    for (const id of ["#tools", "#tab-object", "#tab-playpen"]) $(id).inert = this.hasTwin;
    if (this.stage?.isShown) $("#tools").inert = true;
    this.handling.history.dispatchEvent(new Event("change")); // undo is about it, or about the drawing again
  }

  handleKey(event) {
    if (!this.isActive) return false;
    if (this.handling.liftedIndex !== undefined && (event.key === "[" || event.key === "]")) return this.handling.rotate(event.key === "[" ? 15 : -15);
    const isUndo = readUndoKey(event);
    if (isUndo !== null && !this.isRealRobot) return this.attempt(() => (isUndo ? this.handling.history.undo() : this.handling.history.redo()), "hand"), true;
    if (event.key === " " && !this.isRealRobot) return this.attempt(() => this.pause(), "pace"), true;
    if (event.key === "." && !this.isRealRobot) return this.attempt(() => this.step(), "pace"), true;
    if (event.key === "Escape") return this.attempt(() => post("stop"), "stop"), true;
    return false;
  }
}
