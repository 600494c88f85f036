// Programs and sensor tests that drive a twin or a robot at a port: which there are, and what comes of them.

import { post } from "./api.js";

const $ = (selector) => document.querySelector(selector);
const number = (selector) => ($(selector).value === "" ? null : $(selector).valueAsNumber);

export class Driving {
  #offered = [];

  constructor(running) {
    this.running = running;
    const press = (selector, act, about = "run") => $(selector).addEventListener("click", () => running.attempt(act, about));
    press("#run", () => this.run());
    press("#gather", () => running.begin(() => this.#gather()));
    press("#display", () => this.#figure(), "figure");
    press("#save-sensed", async () => {
      await post("save-sensed", { file: $("#sensed-file").value });
      running.banner(`Saved as ${$("#sensed-file").value}.`);
    }, "#save-sensed");
  }

  // Offers programs, one for each robot; `renew` replaces a list that has changed.
  offer(names, renew) {
    Object.assign(this, { renew });
    this.#offered = names;
    this.choices();
  }

  // Shows as many lists as there are robots: of the twin, or else of the drawing.
  choices() {
    const { active, robots, model } = this.running;
    const count = Math.max(active ? robots.length : model.list("robot").length, 1);
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
    this.choices();
    if (!this.#programs.some(({ value }) => value === file)) $("#controller").value = file;
  }

  // The lists of programs, the first robot's first.
  get #programs() {
    return [$("#controller"), ...document.querySelectorAll("#others select")];
  }

  run() {
    if (this.running.busy) throw new Error("A program is running: Stop ends it, within five seconds.");
    return this.running.begin(() => this.#run());
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

  // A sensor test has ended, perhaps with a warning.
  sensed(warning) {
    const box = $("#sensed-warning");
    box.textContent = warning;
    box.hidden = !warning;
    return this.running.attempt(() => this.#figure(), "figure");
  }

  ran(message) {
    const { fitness, distance_m } = message.metrics;
    const row = document.createElement("tr");
    const whose = this.running.robots.length > 1 ? `robot ${message.robot + 1}: ` : "";
    const cells = [`${whose}${message.number}${message.stopped ? ", stopped" : ""}`, message.cycles, message.seconds.toFixed(1), fitness?.toPrecision(3) ?? "–", distance_m?.toPrecision(3) ?? "–"];
    row.append(...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
    $("#runs-done tbody").append(row);
  }

  // The end of the controller's output; it scrolls along unless the user has scrolled up.
  printed(text) {
    const box = $("#printed");
    const along = box.scrollTop + box.clientHeight >= box.scrollHeight - 4;
    box.hidden = false;
    box.textContent = (box.textContent + text).slice(-20000);
    if (along) box.scrollTop = box.scrollHeight;
  }
}
