// Programs and sensor tests that drive a twin or a robot at a port: their choice, start and results.

import { post } from "./api.js";
import { $, create, createRow, readNumber, showBlob } from "./page.js";

export class Driving {
  #programNames = [];

  constructor(running) {
    this.running = running;
    const press = (selector, act, about = "run") => $(selector).addEventListener("click", () => running.attempt(act, about));
    press("#run", () => this.run());
    press("#gather", () => running.startJob(() => this.#runSensorTest()));
    press("#display", () => this.#showFigure(), "figure");
    press("#save-sensed", async () => {
      await post("save-sensed", { file: $("#sensed-file").value });
      running.banner(`Saved as ${$("#sensed-file").value}.`);
    }, "#save-sensed");
  }

  // Takes the names of the programs; `updateOptions` replaces the options of a list that differ.
  setPrograms(names, updateOptions) {
    this.updateOptions = updateOptions;
    this.#programNames = names;
    this.updateLists();
  }

  // Shows a list of programs for each robot of the twin, or of the drawing if no twin runs.
  updateLists() {
    const { shapes } = this.running;
    const others = $("#others");
    while (others.childElementCount > shapes.length - 1) others.lastChild.remove();
    while (others.childElementCount < shapes.length - 1) others.append(create("label", { className: "wide" }, create("span"), create("select"), create("button", { type: "button" }, "Edit")));
    this.programLists.forEach((list, index) => {
      const { title, programs } = shapes[index];
      list.previousElementSibling.textContent = shapes.length > 1 ? `${index + 1}: ${title}` : "program";
      list.nextElementSibling.dataset.edit = index;
      const choices = [...programs, ...this.#programNames].map((name) => [name, name]);
      if (shapes.length > 1) choices.push(["none: it stands", ""]);
      this.updateOptions?.(list, choices.map(([text, value]) => new Option(text, value)));
    });
  }

  // Selects a program for the robot that it was opened for, if no robot has it.
  selectProgram(file, index) {
    if (!this.#programNames.includes(file)) this.#programNames.push(file);
    this.updateLists();
    if (!this.programLists.some(({ value }) => value === file)) (this.programLists[index] ?? $("#controller")).value = file;
  }

  // The list of programs of each robot.
  get programLists() {
    return [$("#controller"), ...document.querySelectorAll("#others select")];
  }

  run() {
    if (this.running.isBusy) throw new Error("A program is running: Stop ends it, within five seconds.");
    return this.running.startJob(() => this.#run());
  }

  async #run() {
    $('[data-tab="run"]').click();
    $("#runs-done tbody").replaceChildren();
    $("#printed").textContent = "";
    $("#printed").hidden = true;
    $("#part").value = 0;
    await post("run", { controllers: this.programLists.map(({ value }) => value), cycles: readNumber("#cycles"), seconds: readNumber("#seconds"), runs: readNumber("#runs") ?? 1, pause: readNumber("#between") ?? 0, folder: $("#keep").value || null });
  }

  async #runSensorTest() {
    await post("sense", { what: $("#what").value, motion: $("#motion").value, amount: readNumber("#amount"), speed: readNumber("#sense-speed"), acceleration: readNumber("#sense-acceleration"), return: $("#return").checked, text: $("#text").value });
  }

  async #showFigure() {
    const blob = await post("figure", { sensor: $("#sensor").value || null, y_min: readNumber("#y-min") ?? 0, grid: $("#with-grid").checked });
    showBlob($("#figure"), blob, "Counts of the sensors over the path");
  }

  // Shows the result of a sensor test, and its warning if there is one.
  showSensorTest(warning) {
    const box = $("#sensed-warning");
    box.textContent = warning;
    box.hidden = !warning;
    return this.running.attempt(() => this.#showFigure(), "figure");
  }

  // Adds a completed run to the table.
  addRun({ robot, number, stopped, cycles, seconds, metrics: { fitness, distance_m } }) {
    const robotLabel = this.running.robots.length > 1 ? `robot ${robot + 1}: ` : "";
    const cells = [`${robotLabel}${number}${stopped ? ", stopped" : ""}`, cycles, seconds.toFixed(1), fitness?.toPrecision(3) ?? "–", distance_m?.toPrecision(3) ?? "–"];
    $("#runs-done tbody").append(createRow(...cells));
  }
}
