// One run on the page that plays it: its arena in plan and in 3-D, and the chosen robot's readings, lines and events.

import { Curves } from "./curves.js";
import { createSvg, Drawing } from "./drawing.js";
import { LivePlan } from "./live.js";
import { Model } from "./model.js";
import { create, createTable, setText } from "./page.js";
import { Panel, Strip } from "./panel.js";
import { decodeBase64 } from "./replay.js";
import { ThreeD } from "./three_d.js";

const POINTS = 40_000; // of the paths of all robots
const SPAN = 20; // of the curves [s]
const LINES = 200; // of a transcript
const EVENTS = 1000; // listed
const TEXT_INTERVAL = 90; // of numbers and lines while a run plays [ms]
const CHANNELS = { proximity: "proximity", light: "ambient", speed: "speed" }; // by the plot of their curves

export class RunView {
  #index = 0;
  #lastTime = -1;
  #textTime = 0; // of the last numbers and lines [ms]
  #solid = null;
  #isSolid = false;
  #pointers = new Map(); // positions in the window of pressed pointers

  constructor(replay, logNode, { seek, showDialog, onRobot }) {
    const root = document.querySelector("#column").content.firstElementChild.cloneNode(true);
    const find = (selector) => root.querySelector(selector);
    Object.assign(this, { replay, root, find, seek, onRobot });
    find("h2 span").textContent = replay.name;
    find(".about").addEventListener("click", () => showDialog(`About ${replay.name}`, ...this.#about(logNode)));
    root.classList.toggle("real", !replay.draft);
    find(".which").replaceChildren(...replay.robots.map(({ name }, index) => new Option(name, index)));
    find(".which").addEventListener("change", () => this.#select(+find(".which").value));
    this.panel = new Panel(find(".panel"), find(".readings"), find(".bars"));
    this.strip = new Strip(find(".vision"));
    this.curves = new Curves(find(".curves"));
    this.curves.setColours(replay.colours);
    this.limit = Math.ceil(POINTS / replay.robots.length);
    if (replay.draft) this.#createPlan();
    find(".lines").hidden = !Object.values(replay.texts).some(({ length }) => length);
    this.#listEvents();
    this.#select(0, true);
  }

  get robot() {
    return this.replay.robots[this.#index];
  }

  // Chooses a robot by its name.
  choose(name) {
    const index = this.replay.robots.findIndex((robot) => robot.name === name);
    if (index >= 0) this.#select(index, true);
  }

  // Shows a time; after a jump, paths and curves are drawn anew.
  show(time, isJump) {
    const { replay, robot } = this;
    const picture = replay.picture(time);
    const readings = picture.robots[this.#index];
    if (isJump) this.curves.clear([robot]);
    for (const sample of replay.samples(robot, isJump ? time - SPAN : this.#lastTime, time)) this.curves.add(sample);
    const rows = isJump && replay.has(robot, "vision") ? 99 : 0;
    for (let row = rows; row > 0; row--) this.strip.add(replay.readings(robot, time - row / 10), time - row / 10);
    this.strip.add(readings, time);
    if (replay.draft) {
      if (isJump) {
        const paths = replay.robots.map((other) => replay.path(other, time, this.limit));
        this.plan.showPaths(paths);
        this.#solid?.showPaths(paths);
      }
      this.plan.showPicture(picture, undefined, this.#isSolid);
      if (this.#isSolid) this.#solid.showPicture(picture, true);
      this.#showRegion(time);
    }
    this.#lastTime = time;
    if (isJump || performance.now() - this.#textTime > TEXT_INTERVAL) this.#showTexts(time, readings);
  }

  // Shows bars, numbers, lines and the present event, whose layout takes longer than the pictures.
  #showTexts(time, readings) {
    this.#textTime = performance.now();
    const numbers = [readings.x_mm, readings.y_mm, readings.heading_deg].map((value) => value?.toFixed(1));
    const pose = readings.x_mm === undefined ? {} : { "x, y [mm], heading [°]": numbers };
    this.panel.showReadings({ ...readings, more: { ...pose, ...readings.more } });
    const transcript = this.find(".transcript");
    const lines = this.replay.lines(this.robot, time, LINES).join("\n");
    if (transcript.textContent !== lines) {
      transcript.textContent = lines;
      transcript.scrollTop = transcript.scrollHeight;
    }
    this.#markEvent(time);
  }

  // Returns the state of the chosen robot in words.
  describe() {
    const { replay, robot } = this;
    const [time, { x_mm, y_mm, heading_deg }] = [this.#lastTime, replay.picture(this.#lastTime).robots[this.#index]];
    const isTouching = replay.contacts.some(([name, start, end]) => name === robot.name && start <= time && time <= end);
    const place = x_mm === undefined ? "" : `, at ${x_mm.toFixed(0)}, ${y_mm.toFixed(0)} mm, heading ${heading_deg.toFixed(0)} degrees`;
    return `${replay.name}, ${time.toFixed(2)} s, ${robot.name}${place}${isTouching ? ", in contact" : ""}`;
  }

  // Shows 3-D or the plan; returns false without WebGL.
  setSolid(isSolid) {
    try {
      if (isSolid && !this.#solid) {
        this.find(".solid").hidden = false; // its size is read
        this.#solid = new ThreeD(this.find(".solid"), this.limit);
        this.reload();
      }
    } catch {
      this.find(".solid").hidden = true;
      return false;
    }
    this.#isSolid = isSolid;
    this.find(".solid").hidden = !isSolid;
    this.find(".plan").style.visibility = isSolid ? "hidden" : "";
    return true;
  }

  reload() {
    const robots = this.replay.robots.map((robot) => ({ ...robot, path: this.replay.path(robot, this.#lastTime, this.limit) }));
    this.#solid?.load(structuredClone(this.replay.scene), robots, this.replay.lamps);
  }

  toggleFollow() {
    this.#solid?.follow(this.#solid.followedIndex === null ? this.#index : null);
    return this.#solid?.followedIndex != null;
  }

  handleKey(event) {
    return this.#solid.handleKey(event);
  }

  zoom(key) {
    if (this.#isSolid) this.#solid.handleKey({ key });
    else if (key === "0") this.fit();
    else this.drawing?.zoom(key === "+" ? 0.8 : 1.25);
  }

  fit() {
    this.drawing?.fit();
  }

  #createPlan() {
    const { replay } = this;
    const svg = this.find(".plan");
    const model = new Model();
    this.drawing = Object.assign(new Drawing(svg, model), { surfaces: replay.surfaces, turrets: replay.turrets });
    model.load({ draft: { ...replay.draft, robot: [] } });
    this.drawing.drawAll();
    for (const node of this.drawing.nodes.values()) node.removeAttribute("tabindex");
    this.plan = new LivePlan(this.drawing, this.limit);
    this.plan.clear(replay.robots.length);
    this.plan.drawRobots(replay.robots, replay.picture(0));
    svg.addEventListener("pointerdown", (event) => {
      this.#pointers.set(event.pointerId, [event.clientX, event.clientY]);
      const robot = event.target.closest(".live");
      if (robot) this.#select(+robot.dataset.live);
      svg.setPointerCapture(event.pointerId);
    });
    svg.addEventListener("pointermove", (event) => this.#pointers.has(event.pointerId) && this.#drag(event));
    for (const kind of ["pointerup", "pointercancel"]) svg.addEventListener(kind, ({ pointerId }) => this.#pointers.delete(pointerId));
    svg.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.drawing.zoom(1.0015 ** event.deltaY, this.drawing.pointerPosition(event));
    }, { passive: false });
  }

  // Moves the view with a pointer; two fingers also zoom it.
  #drag(event) {
    const [before, other] = [this.#pointers.get(event.pointerId), [...this.#pointers].find(([id]) => id !== event.pointerId)?.[1]];
    const now = [event.clientX, event.clientY];
    this.#pointers.set(event.pointerId, now);
    const { view: { x, y, width, height }, pixelMm } = this.drawing;
    const share = other ? 0.5 : 1;
    this.drawing.setView(x - share * pixelMm * (now[0] - before[0]), y - share * pixelMm * (now[1] - before[1]), width, height);
    const distance = ([a, b]) => Math.hypot(a - other[0], b - other[1]) || 1;
    if (!other) return;
    const middle = { clientX: (now[0] + other[0]) / 2, clientY: (now[1] + other[1]) / 2 };
    this.drawing.zoom(distance(before) / distance(now), this.drawing.pointerPosition(middle));
  }

  #select(index, isQuiet = false) {
    this.#index = index;
    this.find(".which").value = index;
    this.panel.drawRobot(this.robot);
    this.strip.clear();
    for (const [plot, channel] of Object.entries(CHANNELS)) {
      const box = this.curves.boxes[plot];
      const isPresent = this.replay.has(this.robot, channel);
      box.parentElement.hidden = !isPresent;
      if (!isPresent) box.checked = false;
    }
    for (const node of this.drawing?.liveGroup.querySelectorAll(".live") ?? []) node.classList.toggle("chosen", +node.dataset.live === index);
    if (this.#solid && this.#solid.followedIndex !== null) this.#solid.follow(index);
    if (!isQuiet) this.onRobot();
  }

  #showRegion(time) {
    const region = this.replay.region(time);
    this.find(".shadow").hidden = !region;
    if (!region) return;
    const { values: [cx, cy, rx, ry, angle], state, colour } = region;
    this.regionNode ??= this.drawing.overlay.appendChild(createSvg("ellipse", { class: "region" }));
    const attributes = { rx, ry, transform: `translate(${cx} ${cy}) rotate(${angle})`, stroke: `rgb(${colour})` };
    for (const [key, value] of Object.entries(attributes)) this.regionNode.setAttribute(key, value);
    this.find(".shadow i").style.borderColor = `rgb(${colour})`;
    setText(this.find(".shadow output"), state);
  }

  #listEvents() {
    const { events, contacts } = this.replay;
    const entries = [
      ...events.map(([time, name, text, topic]) => ({ time, text: `${name}: ${text}`, kind: topic === "/events" ? "event" : "alarm" })),
      ...contacts.map(([name, time, end]) => ({ time, text: `${name}: contact, ${(end - time).toFixed(2)} s`, kind: "contact" })),
    ].sort((a, b) => a.time - b.time);
    this.entries = entries.slice(0, EVENTS).map(({ time, text, kind }) => {
      const button = create("button", { className: kind }, `${time.toFixed(2)} s  ${text}`);
      button.addEventListener("click", () => this.seek(time));
      return { time, button };
    });
    const rest = entries.length > EVENTS ? [create("li", {}, `… and ${entries.length - EVENTS} later ones`)] : [];
    this.find(".events ol").replaceChildren(...this.entries.map(({ button }) => create("li", {}, button)), ...rest);
    this.find(".events").hidden = !entries.length;
  }

  #markEvent(time) {
    const current = this.entries.filter((entry) => entry.time <= time + 1e-9).at(-1)?.button;
    if (current === this.currentEvent) return;
    this.currentEvent?.removeAttribute("aria-current");
    current?.setAttribute("aria-current", "true");
    if (current) this.find(".events ol").scrollTop = current.offsetTop - this.find(".events ol").offsetTop - 40;
    this.currentEvent = current;
  }

  // Returns the origin of the run, the notes about its samples, and its log if the page has it.
  #about(logNode) {
    const { origin, sources, interval, lineInterval, draft } = this.replay;
    const table = createTable(Object.entries(origin));
    const notes = [
      !draft && "The log has no poses: readings and transcript only.",
      interval && `Of the samples, one in ${interval.toFixed(2)} s is shown, and those at events and contacts.`,
      lineInterval && `Of the transcript, one exchange in ${lineInterval.toFixed(2)} s is shown.`,
    ].filter((note) => note).map((note) => create("p", {}, note));
    const files = Object.entries(sources).flatMap(([name, text]) => [create("h3", {}, name), create("pre", { tabIndex: 0 }, text)]);
    if (!logNode) return [table, ...notes, ...files];
    const href = URL.createObjectURL(new Blob([decodeBase64(logNode.textContent)]));
    const link = create("a", { href, download: logNode.dataset.name }, `Save ${logNode.dataset.name}`);
    return [table, create("p", {}, link), ...notes, ...files];
  }
}
