// Controllers edited in the page: a plain text with the numbers of its lines, saved and run by one key.

import { post } from "./api.js";

const $ = (selector) => document.querySelector(selector);

export class Program {
  #file = null;
  #version = null;
  #saved = "";
  #failed = 0;

  constructor(running, banner, attempt) {
    Object.assign(this, { running, banner, attempt, text: $("#code") });
    running.failed = (text) => this.mark(text);
    $("#edit").addEventListener("click", () => attempt(() => this.edit(), "program"));
    $("#save-program").addEventListener("click", () => attempt(() => this.save(), "program"));
    $("#run-program").addEventListener("click", () => this.run());
    this.text.addEventListener("input", () => this.#show());
    this.text.addEventListener("scroll", () => ($("#lines").scrollTop = this.text.scrollTop));
    this.text.addEventListener("keydown", (event) => this.#key(event));
  }

  get changed() {
    return this.#file !== null && this.text.value !== this.#saved;
  }

  get file() {
    return this.#file;
  }

  // Opens the chosen program, or a new one if a built-in controller is chosen.
  async edit() {
    if (this.changed) throw new Error(`${this.#file} has changes that are not saved: save it first.`);
    const chosen = $("#controller").value;
    const file = chosen.endsWith(".py") ? chosen : "mine.py";
    const { text, version } = await post("program", { file });
    this.#file = file;
    this.#version = version;
    this.#saved = version === null ? "" : text;
    this.#failed = 0;
    this.text.value = text;
    this.text.disabled = false;
    $("#program-file").value = file;
    this.#show();
    $('[data-tab="program"]').click();
    this.text.focus();
  }

  async save(overwrite = false) {
    const [file, text] = [$("#program-file").value.trim().replace(/(\.py)?$/, ".py"), this.text.value];
    try {
      const { version } = await post("save-program", { file, text, version: file === this.#file ? this.#version : null, overwrite });
      this.#file = file;
      this.#version = version;
      this.#saved = text;
    } catch (error) {
      if (!error.conflict) throw error;
      this.banner(error.message, "error", { "Replace it": () => this.save(true) }, "program");
      return false;
    }
    this.#show();
    return true;
  }

  run() {
    return this.attempt(async () => {
      if (!(await this.save())) return;
      this.#failed = 0;
      this.#show();
      if (![...$("#controller").options].some(({ value }) => value === this.#file)) $("#controller").append(new Option(this.#file, this.#file));
      $("#controller").value = this.#file;
      $("#run").click();
    }, "program");
  }

  // Marks the line that an error names, such as in mine.py:3: NameError.
  mark(text) {
    const found = text.match(/([^/\s]+\.py):(\d+):/);
    if (!found || !this.#file?.endsWith(found[1])) return;
    this.#failed = +found[2];
    $("#program-told").textContent = text;
    this.#show();
    $('[data-tab="program"]').click();
    const height = this.text.scrollHeight / this.text.value.split("\n").length;
    this.text.scrollTop = (this.#failed - 5) * height;
  }

  #show() {
    const count = this.text.value.split("\n").length;
    const rows = Array.from({ length: count }, (_, index) => Object.assign(document.createElement("span"), { textContent: index + 1, className: index + 1 === this.#failed ? "failed" : "" }));
    $("#lines").replaceChildren(...rows);
    $("#lines").scrollTop = this.text.scrollTop;
    $("#save-program").disabled = !this.changed;
    if (!this.#failed) $("#program-told").textContent = "";
  }

  // The browser's own undo takes these edits back, too.
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
    } else if (event.key === "Tab" && !event.shiftKey) put("    ");
    else if (event.key === "Enter" && !command) {
      const line = this.text.value.slice(0, this.text.selectionStart).split("\n").at(-1);
      put(`\n${line.match(/^ */)[0]}${line.endsWith(":") ? "    " : ""}`);
    }
  }
}
