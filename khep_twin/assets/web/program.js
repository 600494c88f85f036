// Editor of controllers: plain text with line numbers, saved and run by one key.

import { post } from "./api.js";
import { readUndoKey } from "./model.js";
import { $, create } from "./page.js";
import { TextHistory } from "./text_history.js";

export class Program {
  #programs = new Map(); // by file: each open program, with its history
  #current = null;

  constructor(running, banner, attempt) {
    Object.assign(this, { running, banner, attempt, text: $("#code") });
    running.onError = (text) => this.markErrorLine(text);
    $("#tab-run").addEventListener("click", ({ target: { dataset } }) => dataset.edit && attempt(() => this.edit(+dataset.edit), "program"));
    $("#save-program").addEventListener("click", () => attempt(() => this.save(), "program"));
    $("#run-program").addEventListener("click", () => this.run());
    this.text.addEventListener("input", (event) => {
      this.#current.history.record(this.text.value, event.inputType);
      this.#update();
    });
    this.text.addEventListener("beforeinput", (event) => {
      const isUndo = { historyUndo: true, historyRedo: false }[event.inputType];
      if (isUndo === undefined) return;
      event.preventDefault();
      this.#undo(isUndo);
    });
    this.text.addEventListener("scroll", () => ($("#lines").scrollTop = this.text.scrollTop));
    this.text.addEventListener("keydown", (event) => this.#handleKey(event));
  }

  // True if a program has unsaved changes.
  get hasChanges() {
    return [...this.#programs.values()].some(isChanged);
  }

  // Returns whether a file is open here with unsaved changes.
  isUnsaved(file) {
    return this.#programs.has(file) && isChanged(this.#programs.get(file));
  }

  // Opens the program that is selected for a robot, or with a built-in controller selected a new one for its model.
  async edit(robot = 0) {
    const { shapes, driving } = this.running;
    const { value: selected } = driving.programLists[robot];
    const file = selected.endsWith(".py") ? selected : `mine${robot ? robot + 1 : ""}.py`;
    const reply = await post("program", { file, model: shapes[robot].model });
    const [text, version] = [reply.text.replaceAll("\r\n", "\n"), reply.version]; // a textarea has no \r
    const program = this.#programs.get(file);
    if (!program) this.#programs.set(file, { file, version, savedText: version === null ? "" : text, robot, history: new TextHistory(text), view: [0, 0, 0], errorLine: 0 });
    else if (version !== null && version !== program.version && !isChanged(program)) {
      // Another program has changed the file; undo restores the previous text.
      program.history.record(text);
      Object.assign(program, { version, savedText: text });
    }
    this.#showProgram(this.#programs.get(file));
    $('[data-tab="program"]').click();
    this.text.focus();
  }

  // Shows an open program with its previous selection and scroll position.
  #showProgram(program) {
    const { text } = this;
    if (this.#current) this.#current.view = [text.selectionStart, text.selectionEnd, text.scrollTop];
    this.#current = program;
    text.disabled = false;
    text.value = program.history.text;
    text.setSelectionRange(program.view[0], program.view[1]);
    $("#program-file").value = program.file;
    this.#update();
    text.scrollTop = program.view[2];
  }

  async save(overwrite = false, program = this.#current, file = $("#program-file").value.trim().replace(/(\.py)?$/, ".py")) {
    const { text } = program.history;
    if (file !== program.file && this.isUnsaved(file)) throw new Error(`${file} is open here with changes that are not saved: save it first.`);
    try {
      const { version } = await post("save-program", { file, text, version: file === program.file ? program.version : null, overwrite });
      if (program.version === null) this.running.driving.selectProgram(file, program.robot);
      this.#programs.delete(program.file);
      this.#programs.set(file, Object.assign(program, { file, version, savedText: text }));
    } catch (error) {
      if (!error.conflict) throw error;
      this.banner(error.message, "error", { "Replace it": () => this.save(true, program, file) }, "program");
      return false;
    }
    this.#update();
    return true;
  }

  run() {
    return this.attempt(async () => {
      if (!this.#current) return this.edit();
      if (!(await this.save())) return;
      const { file, robot } = this.#current;
      this.#current.errorLine = 0;
      this.#update();
      this.running.driving.selectProgram(file, robot);
      await this.attempt(() => this.running.driving.run(), "run");
    }, "program");
  }

  // Marks the line that an error message names, for example mine.py:3: NameError.
  markErrorLine(text) {
    const match = text.match(/([^/\s]+\.py):(\d+):/);
    const program = match && [this.#current, ...this.#programs.values()].find((candidate) => `/${candidate?.file}`.endsWith(`/${match[1]}`));
    if (!program) return;
    if (program !== this.#current) this.#showProgram(program);
    program.errorLine = +match[2];
    $("#program-status").textContent = text;
    this.#update();
    $('[data-tab="program"]').click();
    const height = this.text.scrollHeight / this.text.value.split("\n").length;
    this.text.scrollTop = (this.#current.errorLine - 5) * height;
  }

  #undo(isUndo) {
    const { history } = this.#current;
    const caret = isUndo ? history.undo() : history.redo();
    if (caret === undefined) return;
    const { scrollTop } = this.text;
    this.text.value = history.text;
    this.text.setSelectionRange(caret, caret);
    this.#update();
    // Scrolls to the line of the caret if it is not in view.
    const [lines, line] = [history.text, history.text.slice(0, caret)].map((text) => text.split("\n").length);
    const top = ((line - 1) * this.text.scrollHeight) / lines;
    this.text.scrollTop = top < scrollTop || top + 40 > scrollTop + this.text.clientHeight ? top - this.text.clientHeight / 2 : scrollTop;
  }

  #update() {
    const { errorLine } = this.#current;
    const count = this.text.value.split("\n").length;
    const rows = Array.from({ length: count }, (_, index) => create("span", { textContent: index + 1, className: index + 1 === errorLine ? "failed" : "" }));
    $("#lines").replaceChildren(...rows);
    $("#lines").scrollTop = this.text.scrollTop;
    $("#save-program").disabled = !isChanged(this.#current);
    $("#programs").replaceChildren(...[...this.#programs.values()].filter((program) => program !== this.#current).map((program) => {
      const button = create("button", { textContent: `${program.file}${isChanged(program) ? " *" : ""}`, title: "Edit it" });
      button.addEventListener("click", () => this.#showProgram(program));
      return button;
    }));
    if (!errorLine) $("#program-status").textContent = "";
  }

  #handleKey(event) {
    const insert = (text) => {
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
    } else if (readUndoKey(event) !== null) {
      event.preventDefault();
      this.#undo(readUndoKey(event));
    } else if (event.key === "Tab" && !event.shiftKey) insert("    ");
    else if (event.key === "Enter" && !command) {
      const line = this.text.value.slice(0, this.text.selectionStart).split("\n").at(-1);
      insert(`\n${line.match(/^ */)[0]}${line.endsWith(":") ? "    " : ""}`);
    }
  }
}

const isChanged = ({ history, savedText }) => history.text !== savedText;
