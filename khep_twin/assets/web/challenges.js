// Challenges: one program is scored, or all of a folder, in a process that the server supervises.

import { download, post } from "./api.js";
import { $, appendOutput, createRow, showBlob } from "./page.js";

const PASSED = new Map([[true, "passed"], [false, "failed"], [null, ""]]);

export class Challenges {
  #challenges = null;
  #isBusy = false;

  // openFromLibrary(name) opens a playpen of the library; program is the editor of the tab Program.
  constructor({ attempt, program, openFromLibrary }) {
    Object.assign(this, { attempt, program, openFromLibrary });
    const press = (selector, act) => $(selector).addEventListener("click", () => attempt(act, "challenge"));
    $("#challenge").addEventListener("change", () => attempt(() => this.#describe(), "challenge"));
    press("#challenge-playpen", () => this.openFromLibrary(this.#selected.playpen));
    press("#score", () => this.#score());
    press("#score-table", () => this.#scoreFolder());
    press("#score-csv", async () => download(await post("score-csv"), `${this.tableName}.csv`));
    document.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && this.#isBusy && this.isShown && !$("#dialog").open) attempt(() => post("score-stop"), "challenge");
    });
    this.#updateButtons();
  }

  get isShown() {
    return !$("#tab-challenge").hidden;
  }

  // Handlers of messages by their kind (khep_twin/web/messages.py).
  messageHandlers = {
    scoring: (message) => this.#showStart(message),
    "score-printed": ({ text }) => appendOutput($("#score-printed"), text),
    scored: (message) => this.#showScore(message),
    "score-rows": (message) => this.#showRows(message),
    "score-ended": ({ text }) => this.#showEnd(text),
  };

  get #selected() {
    return this.#challenges[$("#challenge").value];
  }

  // Loads the challenges and the state of a scoring; called when the tab is opened.
  async load() {
    const { challenges, now: scoring } = await post("challenges");
    if (!this.#challenges) {
      this.#challenges = challenges;
      $("#challenge").append(...Object.entries(challenges).map(([name, { title }]) => new Option(`${name}: ${title}`, name)));
      await this.#describe();
    }
    if (scoring && !this.#isBusy) this.#showStart(scoring); // this page was loaded meanwhile
  }

  // Takes the programs below the folder; updateOptions replaces the options of a list that differ.
  setPrograms(names, updateOptions) {
    updateOptions($("#scored"), [new Option("reference solution", ""), ...names.map((name) => new Option(name, name))]);
    const folders = new Set(names.filter((name) => name.endsWith(".py")).map((name) => name.replace(/\/?[^/]*$/, "") || "."));
    updateOptions($("#score-folder"), [...folders].sort().map((name) => new Option(name === "." ? "this folder" : name, name)));
    this.#updateButtons();
  }

  async #describe() {
    const { title, description, facts, playpen } = this.#selected;
    $("#challenge-text").textContent = description.replace(/\s+/g, " ");
    $("#challenge-facts").replaceChildren(...Object.entries(facts).map((fact) => createRow(...fact)));
    $("#challenge-playpen").disabled = playpen === null;
    const name = $("#challenge").value;
    const blob = await post("challenge-picture", { name });
    if (name !== $("#challenge").value) return;
    showBlob($("#challenge-picture"), blob, `The playpen: ${title}`);
  }

  async #score() {
    const program = $("#scored").value || null;
    if (program && this.program.isUnsaved(program)) throw new Error(`${program} has changes that are not saved: save it first.`);
    await post("score", { challenge: $("#challenge").value, program });
  }

  #scoreFolder() {
    return post("score-table", { challenge: $("#challenge").value, folder: $("#score-folder").value });
  }

  #showStart({ challenge, program, folder }) {
    this.#isBusy = true;
    if (folder) {
      this.tableName = challenge;
      $("#score-rows tbody").replaceChildren();
      $("#score-part").removeAttribute("value");
      $("#table-status").textContent = `${challenge}: the programs of ${folder === "." ? "this folder" : folder}`;
    } else {
      $("#score-runs").replaceChildren();
      $("#score-printed").textContent = "";
      $("#score-printed").hidden = true;
      this.#showStatus(`${challenge}: ${program} is being scored`);
    }
    this.isTable = Boolean(folder);
    this.#updateButtons();
  }

  #showStatus(text, kind = "") {
    Object.assign($("#score-status"), { textContent: text, className: kind });
  }

  #showScore({ program, score, runs, passes, threshold, reference, reason }) {
    if (score === null) {
      this.#showStatus(reason, "failed");
      this.program.markErrorLine(reason);
      return;
    }
    const rows = runs.length > 1 ? runs.map((value, index) => [`run ${index + 1}`, value]) : [];
    rows.push(["score", score]);
    if (reference !== null) rows.push(["reference", reference]);
    if (threshold) rows.push([PASSED.get(passes), threshold]);
    $("#score-runs").replaceChildren(...rows.map((cells) => createRow(...cells)));
    this.#showStatus(`${program}: ${PASSED.get(passes) || "scored"}`, passes === false ? "failed" : "passed");
  }

  #showRows({ part, rows }) {
    $("#score-part").value = part;
    $("#score-rows tbody").replaceChildren(
      ...rows.map(({ rank, participant, score, passes, note }) => {
        const row = createRow(rank ?? "–", participant, score, PASSED.get(passes), note);
        row.lastChild.title = note;
        return row;
      }),
    );
    this.#updateButtons();
  }

  #showEnd(text) {
    this.#isBusy = false;
    if (this.isTable) $("#score-part").value = 0;
    if (text && this.isTable) $("#table-status").textContent = text;
    else if (text) this.#showStatus(text, "failed");
    this.#updateButtons();
  }

  #updateButtons() {
    $("#score").disabled = this.#isBusy;
    $("#score-table").disabled = this.#isBusy || !$("#score-folder").value;
    $("#score-csv").disabled = !$("#score-rows tbody").childElementCount;
    $("#scored-stop").disabled = !this.#isBusy || this.isTable;
    $("#table-stop").disabled = !this.#isBusy || !this.isTable;
  }
}
