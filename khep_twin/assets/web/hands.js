// The history of manual changes to a running twin, robots moved and lamps switched, with undo and redo.

import { post } from "./api.js";

// A change has two requests, `redo` and `undo`, each an action and its values.
export class ManualHistory extends EventTarget {
  #changes = { done: [], undone: [] };
  #previous = this.#changes; // before the last request, which the twin may still refuse

  // Clears the history for another twin.
  clear() {
    this.#setChanges({ done: [], undone: [] });
    this.#previous = this.#changes;
  }

  // Makes a change; without `undo`, before the twin's first picture, it is not part of the history.
  do(redo, undo) {
    if (!undo) return post(...redo);
    return this.#request({ done: [...this.#changes.done, { redo, undo }].slice(-300), undone: [] }, redo);
  }

  undo() {
    const { done, undone } = this.#changes;
    const change = done.at(-1);
    return change && this.#request({ done: done.slice(0, -1), undone: [...undone, change] }, change.undo);
  }

  redo() {
    const { done, undone } = this.#changes;
    const change = undone.at(-1);
    return change && this.#request({ done: [...done, change], undone: undone.slice(0, -1) }, change.redo);
  }

  // Restores the history after a refused request.
  revert() {
    this.#setChanges(this.#previous);
  }

  get canUndo() {
    return this.#changes.done.length > 0;
  }

  get canRedo() {
    return this.#changes.undone.length > 0;
  }

  async #request(changes, [action, values]) {
    this.#previous = this.#changes;
    this.#setChanges(changes);
    try {
      await post(action, values);
    } catch (error) {
      this.revert();
      throw error;
    }
  }

  #setChanges(changes) {
    this.#changes = changes;
    this.dispatchEvent(new Event("change"));
  }
}
