// The open playpen: its file is opened and saved, unsaved changes are stored as a draft, conflicts are reported.
//
// The server stores a draft for each page and playpen. State of this page's draft of the open playpen:
//
//            change               0.8 s later, or the page is hidden
//   clean ------------> pending ------------------------------------> stored
//     ^                  |   ^                                          |
//     |    undo, save    |   |                 change                   |
//     |------------------+   +------------------------------------------|
//     |             undo, save: the server deletes the draft            |
//     +-----------------------------------------------------------------+
//
// Another document starts clean. A draft that another page has left is offered: "Continue it" restores it, "Discard
// it" deletes it. A conflict is a file that has changed since it was opened: the user loads or replaces it.

import { post, tab, upload } from "./api.js";
import { $, create } from "./page.js";

export class Drafts {
  #state = {
    isStored: false, // the server has this page's draft
    timer: undefined, // defined while the draft is pending
    lastSave: Promise.resolve(), // the next save waits for it
    offer: null, // the offered draft: its page, and a function that closes the banner
  };

  // send(message) sends a message to the other pages; the other functions are those of main.js.
  constructor({ model, running, attempt, banner, settle, ask, send }) {
    Object.assign(this, { model, running, attempt, banner, settle, ask, send });
    model.addEventListener("document", ({ detail }) => this.#showDocument(detail));
  }

  // Opens a file, unless the user keeps unsaved changes.
  async open(file) {
    if (file && (await this.#mayLeave())) await this.#load(file);
  }

  async openFromLibrary(name) {
    if (await this.#mayLeave()) await this.#replaceDocument(await post("library", { name }), { library: name });
  }

  async importFile(file) {
    if (!file || !(await this.#mayLeave())) return;
    const input = create("input", { type: "number", value: 1, step: "any", min: 0.01 });
    if (!(await this.ask(`Import ${file.name}`, create("label", {}, "Size of a pixel in mm: ", input), "Import"))) return;
    const deletion = this.#replaceDocument(await upload(file, input.value), {});
    this.model.document.savedText = "";
    this.showTitle();
    await deletion;
  }

  // Saves the playpen after the previous save, from the version that it has written.
  save(file = this.model.file, overwrite = false, rename = false) {
    if (!file) return this.saveAs();
    const { openCount } = this.model;
    const save = this.#state.lastSave.then(() => this.model.openCount === openCount && this.#write(file, overwrite, rename));
    this.#state.lastSave = save.catch(() => {});
    return save;
  }

  async saveAs() {
    const { file, draft } = this.model;
    const input = create("input", { value: file ?? `${draft.name}.toml` });
    input.setAttribute("aria-label", "Name of the file");
    if (!(await this.ask("Save as", input, "Save"))) return;
    const name = input.value.trim().replace(/(\.toml)?$/, ".toml");
    // A file under another name renames the playpen.
    await this.save(name, false, name !== this.model.file);
  }

  storeSoon() {
    clearTimeout(this.#state.timer);
    this.#state.timer = setTimeout(() => this.store(), 800);
  }

  // Stores the draft; deletes it if all changes were undone.
  store(options = {}) {
    clearTimeout(this.#state.timer);
    this.#state.timer = undefined;
    const { draft, isChanged, document: { file, version, base } } = this.model;
    if (!isChanged && !this.#state.isStored) return undefined;
    this.#state.isStored = isChanged;
    return this.attempt(() => post("keep", { file, version, base, draft: isChanged ? draft : null }, options), "keep");
  }

  // Offers the newest of the drafts that other pages have left of this document, then the next.
  offer(drafts) {
    const { model } = this;
    const [newest, ...others] = drafts.filter(({ page, draft }) => page !== tab && JSON.stringify(draft) !== JSON.stringify(model.draft));
    if (!newest) return;
    const { file, openCount } = model;
    const { page, time } = newest;
    const date = new Date(time * 1000).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
    const close = this.banner(`A draft of ${file ?? "a new playpen"} was never saved (${date}).`, "", {
      "Continue it": async () => {
        if (this.running.hasTwin) {
          this.offer(drafts);
          throw new Error("A twin runs in this drawing: end it first.");
        }
        // Its page may have stored it again when it was closed.
        const { draft, version = model.document.version, base } = (await post("left", { file })).left.find((other) => other.page === page) ?? newest;
        if (model.openCount !== openCount) return;
        // From the version that the draft was made from, so that Save asks if the file has changed since.
        Object.assign(model.document, { version, base: base ?? model.document.base });
        model.replace(draft);
        if (await this.store()) await discard(file, page);
      },
      "Discard it": async () => {
        await discard(file, page);
        if (model.openCount === openCount) this.offer(others);
      },
    }, "draft");
    this.#state.offer = { page, close };
  }

  // Reports the open file to the other pages; with `ask`, these answer.
  announce(ask) {
    this.send({ file: this.model.file, tab, ask });
  }

  showTitle() {
    $("#file").textContent = $("#file").title = `${this.model.file ?? "new playpen"}${this.model.isChanged ? " *" : ""}`;
    document.title = `${$("#file").textContent} – Khepera designer`;
  }

  // Handlers of messages by their kind (khep_twin/web/messages.py).
  messageHandlers = {
    saved: ({ by, file, version }) => {
      if (by === tab || file !== this.model.file || version === this.model.document.version) return;
      this.banner(`${file} was saved by another page.`, "error", { "Load it anew": () => this.#load(file), "Keep mine": () => {} }, "conflict");
    },
    page: ({ said }) => {
      const other = JSON.parse(said);
      if (other.tab === tab || other.file !== this.model.file) return;
      // The other page still uses a draft that was considered abandoned.
      if (other.tab === this.#state.offer?.page) this.#state.offer.close();
      this.banner(`Another page has ${this.model.file ?? "a new playpen"} open, too: the second page to save must confirm.`, "", {}, "others");
      if (other.ask) this.announce();
    },
  };

  // Asks before unsaved changes are discarded with their draft, and ends the twin that runs in the drawing.
  async #mayLeave() {
    const text = create("p", {}, "There are changes that are not saved. Undo brings them back, while this page is open.");
    if (this.model.isChanged && !(await this.ask("Leave this playpen?", text, "Discard them"))) return false;
    await this.#endTwin();
    return true;
  }

  async #endTwin() {
    if (this.running.hasTwin) await post("end");
  }

  async #load(file) {
    await this.#endTwin();
    await this.#replaceDocument(await post("open", { file }), { file });
  }

  // Opens a document instead of the current one, whose changes the user has discarded, and offers its drafts.
  #replaceDocument(reply, base) {
    const { file } = this.model;
    this.model.load(reply, base);
    this.offer(reply.left ?? []);
    return discard(file);
  }

  // Shows a document that was opened, or to which undo or redo has returned.
  #showDocument({ previous, isHistory }) {
    // These banners are about the previous document.
    for (const banner of [...$("#banners").children]) if (["file", "draft", "conflict", "others"].includes(banner.dataset.about)) banner.remove();
    const wasStored = this.#state.isStored;
    this.#state.isStored = false;
    this.#setHash();
    this.announce(true);
    if (!isHistory) return;
    if (wasStored) this.attempt(() => discard(previous.file), "keep"); // the history has its changes
    this.banner(`${this.model.file ?? "A new playpen"} is open again.`, "", {}, "file");
  }

  // The hash makes a reloaded page open the same document; every file ends in .toml.
  #setHash() {
    history.replaceState(null, "", this.model.file ? `#${encodeURIComponent(this.model.file)}` : "#new");
  }

  async #write(file, overwrite, rename) {
    const { model } = this;
    const draft = structuredClone(model.draft);
    const { file: previousFile, openCount } = model;
    try {
      const version = file === previousFile ? model.document.version : null;
      const reply = await post("save", { file, draft, version, base: model.document.base, overwrite, rename });
      if (previousFile !== file) await discard(previousFile);
      if (model.openCount !== openCount) return;
      this.#state.isStored = false;
      if (rename) draft.name = model.draft.name = reply.name;
      model.commit();
      Object.assign(model.document, { file, version: reply.version, base: { file }, savedText: JSON.stringify(draft) });
      this.showTitle();
      this.#setHash();
      if (model.isChanged) this.storeSoon();
      this.settle("conflict");
      this.banner(`Saved as ${file}.`, "", {}, "file");
    } catch (error) {
      if (!error.conflict || model.openCount !== openCount) throw error;
      this.banner(error.message, "error", {
        "Load it again": () => this.#load(file),
        "Save under another name": () => this.saveAs(),
        "Replace it": () => this.save(file, true, rename),
      }, "conflict");
    }
  }
}

// Deletes a page's draft of a document, by default this page's.
const discard = (file, page) => post("keep", { file, draft: null, page });
