// Controllers edited in the page: a plain text with the numbers of its lines, saved and run by one key.

import { post } from "./api.js";
import { undoKey } from "./model.js";
import { TextHistory } from "./text_history.js";

const $ = (selector) => document.querySelector(selector);

export class Program {
  #open = new Map(); // by file: each program has a history of its own while the page is open
  #shown = null;

  constructor(running, banner, attempt) {
    Object.assign(this, { running, banner, attempt, text: $("#code") });
    running.failed = (text) => this.mark(text);
    $("#edit").addEventListener("click", () => attempt(() => this.edit(), "program"));
    $("#save-program").addEventListener("click", () => attempt(() => this.save(), "program"));
    $("#run-program").addEventListener("click", () => this.run());
    this.text.addEventListener("input", (event) => {
      this.#shown.history.record(this.text.value, event.inputType);
      this.#show();
    });
    this.text.addEventListener("beforeinput", (event) => {
      const back = { historyUndo: true, historyRedo: false }[event.inputType];
      if (back === undefined) return;
      event.preventDefault();
      this.#undo(back);
    });
    this.text.addEventListener("scroll", () => ($("#lines").scrollTop = this.text.scrollTop));
    this.text.addEventListener("keydown", (event) => this.#key(event));
  }

  // True if a program has changes that are not saved.
  get changed() {
    return [...this.#open.values()].some(changed);
  }

  // Returns whether a file is open here with changes that are not saved.
  unsaved(file) {
    return this.#open.has(file) && changed(this.#open.get(file));
  }

  // Opens the chosen program, or a new one if a built-in controller is chosen.
  async edit() {
    const chosen = $("#controller").value;
    const file = chosen.endsWith(".py") ? chosen : "mine.py";
    const { text: found, version } = await post("program", { file });
    const text = found.replaceAll("\r\n", "\n"); // as the page has it
    const program = this.#open.get(file);
    if (!program) this.#open.set(file, { file, version, saved: version === null ? "" : text, history: new TextHistory(text), place: [0, 0, 0], failed: 0 });
    else if (version !== null && version !== program.version && !changed(program)) {
      // Another program has changed the file; undo brings back what it was.
      program.history.record(text);
      Object.assign(program, { version, saved: text });
    }
    this.#turn(this.#open.get(file));
    $('[data-tab="program"]').click();
    this.text.focus();
  }

  // Shows an open program where it was left.
  #turn(program) {
    const { text } = this;
    if (this.#shown) this.#shown.place = [text.selectionStart, text.selectionEnd, text.scrollTop];
    this.#shown = program;
    text.disabled = false;
    text.value = program.history.text;
    text.setSelectionRange(program.place[0], program.place[1]);
    $("#program-file").value = program.file;
    this.#show();
    text.scrollTop = program.place[2];
  }

  async save(overwrite = false, program = this.#shown, file = $("#program-file").value.trim().replace(/(\.py)?$/, ".py")) {
    const { text } = program.history;
    if (file !== program.file && this.unsaved(file)) throw new Error(`${file} is open here with changes that are not saved: save it first.`);
    try {
      const { version } = await post("save-program", { file, text, version: file === program.file ? program.version : null, overwrite });
      this.#open.delete(program.file);
      this.#open.set(file, Object.assign(program, { file, version, saved: text }));
    } catch (error) {
      if (!error.conflict) throw error;
      this.banner(error.message, "error", { "Replace it": () => this.save(true, program, file) }, "program");
      return false;
    }
    this.#show();
    return true;
  }

  run() {
    return this.attempt(async () => {
      if (!this.#shown) return this.edit();
      if (!(await this.save())) return;
      const { file } = this.#shown;
      this.#shown.failed = 0;
      this.#show();
      this.running.driving.choose(file);
      await this.attempt(() => this.running.driving.run(), "run");
    }, "program");
  }

  // Marks the line that an error names, such as in mine.py:3: NameError.
  mark(text) {
    const found = text.match(/([^/\s]+\.py):(\d+):/);
    const failed = found && [this.#shown, ...this.#open.values()].find((program) => `/${program?.file}`.endsWith(`/${found[1]}`));
    if (!failed) return;
    if (failed !== this.#shown) this.#turn(failed);
    this.#shown.failed = +found[2];
    $("#program-told").textContent = text;
    this.#show();
    $('[data-tab="program"]').click();
    const height = this.text.scrollHeight / this.text.value.split("\n").length;
    this.text.scrollTop = (this.#shown.failed - 5) * height;
  }

  #undo(back) {
    const { history } = this.#shown;
    const caret = back ? history.undo() : history.redo();
    if (caret === undefined) return;
    const { scrollTop } = this.text;
    this.text.value = history.text;
    this.text.setSelectionRange(caret, caret);
    this.#show();
    // The line of the caret stays in view.
    const [lines, line] = [history.text, history.text.slice(0, caret)].map((text) => text.split("\n").length);
    const top = ((line - 1) * this.text.scrollHeight) / lines;
    this.text.scrollTop = top < scrollTop || top + 40 > scrollTop + this.text.clientHeight ? top - this.text.clientHeight / 2 : scrollTop;
  }

  #show() {
    const { failed } = this.#shown;
    const count = this.text.value.split("\n").length;
    const rows = Array.from({ length: count }, (_, index) => Object.assign(document.createElement("span"), { textContent: index + 1, className: index + 1 === failed ? "failed" : "" }));
    $("#lines").replaceChildren(...rows);
    $("#lines").scrollTop = this.text.scrollTop;
    $("#save-program").disabled = !changed(this.#shown);
    $("#programs").replaceChildren(...[...this.#open.values()].filter((program) => program !== this.#shown).map((program) => {
      const button = Object.assign(document.createElement("button"), { textContent: `${program.file}${changed(program) ? " *" : ""}`, title: "Edit it" });
      button.addEventListener("click", () => this.#turn(program));
      return button;
    }));
    if (!failed) $("#program-told").textContent = "";
  }

  #key(event) {
    const put = (text) => {
      event.preventDefault();
      document.execCommand("insertText", false, text);
    };
    const command = event.ctrlKey || event.metaKey;
    if (command && event.key === "Enter") {
      event.preventDefault();
      this.run();
    } else if (command && event.key.toLowerCase() === "s") {
      event.preventDefault();
      event.stopPropagation();
      this.attempt(() => this.save(), "program");
    } else if (undoKey(event) !== null) {
      event.preventDefault();
      this.#undo(undoKey(event));
    } else if (event.key === "Tab" && !event.shiftKey) put("    ");
    else if (event.key === "Enter" && !command) {
      const line = this.text.value.slice(0, this.text.selectionStart).split("\n").at(-1);
      put(`\n${line.match(/^ */)[0]}${line.endsWith(":") ? "    " : ""}`);
    }
  }
}

const changed = ({ history, saved }) => history.text !== saved;
