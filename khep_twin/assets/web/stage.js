// The arena in 3-D instead of the plan, on a key or a button; three.js is loaded at the first request.

import { post } from "./api.js";
import { $ } from "./page.js";

export class Stage {
  isShown = false;
  #view = null;
  #timer = 0;
  #requestCount = 0;

  // Without WebGL, `showPreview` shows the scene as the server draws it.
  constructor(model, running, attempt, showPreview) {
    Object.assign(this, { model, running, attempt, showPreview });
    running.stage = this;
    $("#three-d").addEventListener("click", () => this.toggle());
    $("#follow").addEventListener("click", () => this.toggleFollow());
    $("#which").addEventListener("change", () => this.#view?.followedIndex != null && this.#view.follow(running.selectedIndex));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.reload());
    model.addEventListener("change", ({ detail }) => detail === "draft" && !running.hasTwin && this.loadSoon());
  }

  toggle() {
    return this.attempt(async () => {
      if (!this.#view) {
        const { ThreeD } = await import("./three_d.js");
        try {
          this.#view = new ThreeD($("#solid"));
        } catch {
          return this.showPreview();
        }
      }
      this.isShown = !this.isShown;
      $("#three-d").setAttribute("aria-pressed", this.isShown);
      $("#solid").hidden = !this.isShown;
      $("#view").style.visibility = this.isShown ? "hidden" : "";
      $("#tools").inert = this.isShown || this.running.hasTwin;
      (this.isShown ? $("#solid") : $("#view")).focus({ preventScroll: true });
      this.#updateButtons();
      if (this.isShown) await this.load();
    }, "three-d");
  }

  toggleFollow() {
    this.#view?.follow(this.#view.followedIndex === null ? this.running.selectedIndex : null);
    this.#updateButtons();
  }

  zoom(key) {
    return this.isShown && this.#view.handleKey({ key });
  }

  // Loads the scene 0.3 s after the last change of the drawing.
  loadSoon() {
    clearTimeout(this.#timer);
    if (this.isShown) this.#timer = setTimeout(() => this.attempt(() => this.load(), "three-d"), 300);
  }

  async load() {
    const request = ++this.#requestCount;
    const { hasTwin } = this.running;
    if (!hasTwin && this.model.problems.length) return; // they are listed; the last scene stays
    const scene = await post("scene", hasTwin ? {} : { draft: this.model.draft });
    if (request === this.#requestCount) this.#view.load(scene, this.running.robotPaths, this.model.partsOf("lamp").map(({ power_w, dim = 1 }) => power_w * dim));
    this.#updateButtons();
  }

  // Loads the scene of a twin that has started, of the drawing after its end, or in the page's other colours.
  reload() {
    if (this.isShown) this.attempt(() => this.load(), "three-d");
    this.#updateButtons();
  }

  showPicture(message) {
    if (this.isShown) this.#view.showPicture(message);
  }

  handleKey(event) {
    if (event.ctrlKey || event.metaKey) return false;
    if (event.key === "3") return this.toggle(), true;
    if (!this.isShown) return false;
    if (event.key === "f") return this.toggleFollow(), true;
    return this.#view.handleKey(event);
  }

  #updateButtons() {
    $("#follow").hidden = !this.isShown || !this.running.hasTwin;
    $("#follow").setAttribute("aria-pressed", this.#view?.followedIndex != null);
  }
}
