// Challenges: one program is scored, or all of a folder, in a process that the server watches.

import { keep, post } from "./api.js";

const $ = (selector) => document.querySelector(selector);
const PASSED = new Map([[true, "passed"], [false, "failed"], [null, ""]]);

function row(...cells) {
  const made = document.createElement("tr");
  made.append(...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
  return made;
}

export class Challenges {
  #found = null;
  #busy = false;

  // open(name) opens a playpen of the library; program is the one of the tab Program.
  constructor({ attempt, program, open }) {
    Object.assign(this, { attempt, program, open });
    const press = (selector, act) => $(selector).addEventListener("click", () => attempt(act, "challenge"));
    $("#challenge").addEventListener("change", () => attempt(() => this.#describe(), "challenge"));
    press("#challenge-playpen", () => this.open(this.#chosen.playpen));
    press("#score", () => this.#score());
    press("#score-table", () => this.#table());
    press("#score-csv", async () => keep(await post("score-csv"), `${this.named}.csv`));
    document.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && this.#busy && this.shown && !$("#dialog").open) attempt(() => post("score-stop"), "challenge");
    });
    this.#buttons();
  }

  get shown() {
    return !$("#tab-challenge").hidden;
  }

  get #chosen() {
    return this.#found[$("#challenge").value];
  }

  // Called when the tab is opened.
  async show() {
    const { challenges, now } = await post("challenges");
    if (!this.#found) {
      this.#found = challenges;
      $("#challenge").append(...Object.entries(challenges).map(([name, { title }]) => new Option(`${name}: ${title}`, name)));
      await this.#describe();
    }
    if (now && !this.#busy) this.#begun(now); // this page was loaded meanwhile
  }

  // Takes the programs below the folder; renew replaces the choices of a list.
  programs(names, renew) {
    renew($("#scored"), [new Option("reference solution", ""), ...names.map((name) => new Option(name, name))]);
    const folders = new Set(names.filter((name) => name.endsWith(".py")).map((name) => name.replace(/\/?[^/]*$/, "") || "."));
    renew($("#score-folder"), [...folders].sort().map((name) => new Option(name === "." ? "this folder" : name, name)));
    this.#buttons();
  }

  async #describe() {
    const { title, description, facts, playpen } = this.#chosen;
    $("#challenge-text").textContent = description.replace(/\s+/g, " ");
    $("#challenge-facts").replaceChildren(...Object.entries(facts).map((fact) => row(...fact)));
    $("#challenge-playpen").disabled = playpen === null;
    const name = $("#challenge").value;
    const blob = await post("challenge-picture", { name });
    if (name !== $("#challenge").value) return;
    const picture = $("#challenge-picture");
    URL.revokeObjectURL(picture.src);
    Object.assign(picture, { src: URL.createObjectURL(blob), alt: `The playpen: ${title}`, hidden: false });
  }

  async #score() {
    const program = $("#scored").value || null;
    if (program && this.program.unsaved(program)) throw new Error(`${program} has changes that are not saved: save it first.`);
    await post("score", { challenge: $("#challenge").value, program });
  }

  #table() {
    return post("score-table", { challenge: $("#challenge").value, folder: $("#score-folder").value });
  }

  // What it does about each kind of message (khep_twin/web/messages.py).
  hears = {
    scoring: (message) => this.#begun(message),
    "score-printed": ({ text }) => this.#printed(text),
    scored: (message) => this.#scored(message),
    "score-rows": (message) => this.#rows(message),
    "score-ended": ({ text }) => this.#ended(text),
  };

  #begun({ challenge, program, folder }) {
    this.#busy = true;
    if (folder) {
      this.named = challenge;
      $("#score-rows tbody").replaceChildren();
      $("#score-part").removeAttribute("value");
      $("#table-told").textContent = `${challenge}: the programs of ${folder === "." ? "this folder" : folder}`;
    } else {
      $("#score-runs").replaceChildren();
      $("#score-printed").textContent = "";
      $("#score-printed").hidden = true;
      this.#tell(`${challenge}: ${program} is being scored`);
    }
    this.table = Boolean(folder);
    this.#buttons();
  }

  #tell(text, kind = "") {
    Object.assign($("#score-told"), { textContent: text, className: kind });
  }

  #printed(text) {
    const box = $("#score-printed");
    box.hidden = false;
    box.textContent = (box.textContent + text).slice(-20000);
    box.scrollTop = box.scrollHeight;
  }

  #scored({ program, score, runs, passes, threshold, reference, reason }) {
    if (score === null) {
      this.#tell(reason, "failed");
      this.program.mark(reason);
      return;
    }
    const rows = runs.length > 1 ? runs.map((value, index) => [`run ${index + 1}`, value]) : [];
    rows.push(["score", score]);
    if (reference !== null) rows.push(["reference", reference]);
    if (threshold) rows.push([PASSED.get(passes), threshold]);
    $("#score-runs").replaceChildren(...rows.map((cells) => row(...cells)));
    this.#tell(`${program}: ${PASSED.get(passes) || "scored"}`, passes === false ? "failed" : "passed");
  }

  #rows({ part, rows }) {
    $("#score-part").value = part;
    $("#score-rows tbody").replaceChildren(
      ...rows.map(({ rank, participant, score, passes, note }) => {
        const made = row(rank ?? "–", participant, score, PASSED.get(passes), note);
        made.lastChild.title = note;
        return made;
      }),
    );
    this.#buttons();
  }

  #ended(text) {
    this.#busy = false;
    if (this.table) $("#score-part").value = 0;
    if (text && this.table) $("#table-told").textContent = text;
    else if (text) this.#tell(text, "failed");
    this.#buttons();
  }

  #buttons() {
    $("#score").disabled = this.#busy;
    $("#score-table").disabled = this.#busy || !$("#score-folder").value;
    $("#score-csv").disabled = !$("#score-rows tbody").childElementCount;
    $("#scored-stop").disabled = !this.#busy || this.table;
    $("#table-stop").disabled = !this.#busy || !this.table;
  }
}
