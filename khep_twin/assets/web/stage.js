// The arena in 3-D instead of the plan, on a key or a button; three.js is loaded when it is first wanted.

import { post } from "./api.js";

const $ = (selector) => document.querySelector(selector);

export class Stage {
  shown = false;
  #view = null;
  #waiting = 0;
  #asked = 0;

  // Without WebGL, `picture` shows the scene as the server draws it.
  constructor(model, running, attempt, picture) {
    Object.assign(this, { model, running, attempt, picture });
    running.stage = this;
    $("#three-d").addEventListener("click", () => this.toggle());
    $("#follow").addEventListener("click", () => this.follow());
    $("#which").addEventListener("change", () => this.#view?.followed != null && this.#view.follow(running.which));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.changed());
    model.addEventListener("change", ({ detail }) => detail === "whole" && !running.twin && this.soon());
  }

  toggle() {
    return this.attempt(async () => {
      if (!this.#view) {
        const { ThreeD } = await import("./three_d.js");
        try {
          this.#view = new ThreeD($("#solid"));
        } catch {
          return this.picture();
        }
      }
      this.shown = !this.shown;
      $("#three-d").setAttribute("aria-pressed", this.shown);
      $("#solid").hidden = !this.shown;
      $("#view").style.visibility = this.shown ? "hidden" : "";
      $("#tools").inert = this.shown || this.running.twin;
      (this.shown ? $("#solid") : $("#view")).focus({ preventScroll: true });
      this.#buttons();
      if (this.shown) await this.load();
    }, "three-d");
  }

  follow() {
    this.#view?.follow(this.#view.followed === null ? this.running.which : null);
    this.#buttons();
  }

  zoom(key) {
    return this.shown && this.#view.key({ key });
  }

  // Loads the scene anew when the drawing has been left alone for a moment.
  soon() {
    clearTimeout(this.#waiting);
    if (this.shown) this.#waiting = setTimeout(() => this.attempt(() => this.load(), "three-d"), 300);
  }

  async load() {
    const asked = ++this.#asked;
    const { twin } = this.running;
    if (!twin && this.model.problems.length) return; // which are told; the last scene stays
    const scene = await post("scene", twin ? {} : { draft: this.model.draft });
    if (asked === this.#asked) this.#view.load(scene, this.running.travellers, this.model.list("lamp").map(({ power_w, dim = 1 }) => power_w * dim));
    this.#buttons();
  }

  // A twin has started or ended, or the page's colours are others.
  changed() {
    if (this.shown) this.attempt(() => this.load(), "three-d");
    this.#buttons();
  }

  told(message) {
    if (this.shown) this.#view.picture(message);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey) return false;
    if (event.key === "3") return this.toggle(), true;
    if (!this.shown) return false;
    if (event.key === "f") return this.follow(), true;
    return this.#view.key(event);
  }

  #buttons() {
    $("#follow").hidden = !this.shown || !this.running.twin;
    $("#follow").setAttribute("aria-pressed", this.#view?.followed != null);
  }
}
