// What was done to a running twin by hand, robots moved and lamps switched, with undo and redo.

import { post } from "./api.js";

// Each move has the requests that take it back and that do it again: an action and its values.
export class Hands extends EventTarget {
  #moves = { done: [], undone: [] };
  #before = this.#moves; // the last request, which may still be refused

  // Another twin, to which nothing has been done yet.
  clear() {
    this.#take({ done: [], undone: [] });
    this.#before = this.#moves;
  }

  // Does something, which has no way back before the twin's first picture.
  do(again, back) {
    if (!back) return post(...again);
    return this.#ask({ done: [...this.#moves.done, { again, back }].slice(-300), undone: [] }, again);
  }

  undo() {
    const { done, undone } = this.#moves;
    const move = done.at(-1);
    return move && this.#ask({ done: done.slice(0, -1), undone: [...undone, move] }, move.back);
  }

  redo() {
    const { done, undone } = this.#moves;
    const move = undone.at(-1);
    return move && this.#ask({ done: [...done, move], undone: undone.slice(0, -1) }, move.again);
  }

  // The twin has refused the last one, as there is no room.
  refused() {
    this.#take(this.#before);
  }

  get canUndo() {
    return this.#moves.done.length > 0;
  }

  get canRedo() {
    return this.#moves.undone.length > 0;
  }

  async #ask(moves, [action, values]) {
    this.#before = this.#moves;
    this.#take(moves);
    try {
      await post(action, values);
    } catch (error) {
      this.refused();
      throw error;
    }
  }

  #take(moves) {
    this.#moves = moves;
    this.dispatchEvent(new Event("change"));
  }
}
