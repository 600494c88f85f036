// The history of a text, with undo and redo: typing is undone word by word, other edits one by one.

const LIMIT = 1000; // steps

export class TextHistory {
  #undoSteps = [];
  #redoSteps = [];

  constructor(text) {
    this.text = text;
  }

  // Records the text after an edit; `kind` is the inputType of its event.
  record(text, kind = "") {
    const step = { ...findDifference(this.text, text), kind };
    if (!step.removed && !step.added) return;
    this.text = text;
    this.#redoSteps = [];
    if (!mergeStep(this.#undoSteps.at(-1), step)) this.#undoSteps.push(step);
    if (this.#undoSteps.length > LIMIT) this.#undoSteps.shift();
  }

  // Returns the new position of the caret; undefined if there is no step to undo.
  undo() {
    return this.#apply(this.#undoSteps, this.#redoSteps, "added", "removed");
  }

  redo() {
    return this.#apply(this.#redoSteps, this.#undoSteps, "removed", "added");
  }

  #apply(from, to, oldKey, newKey) {
    const step = from.pop();
    if (!step) return undefined;
    to.push({ ...step, kind: "" }); // further typing is another step
    this.text = this.text.slice(0, step.start) + step[newKey] + this.text.slice(step.start + step[oldKey].length);
    return step.start + step[newKey].length;
  }
}

function findDifference(before, after) {
  const shorter = Math.min(before.length, after.length);
  let start = 0;
  while (start < shorter && before[start] === after[start]) start++;
  let tail = 0; // length of the common end
  while (tail < shorter - start && before.at(-1 - tail) === after.at(-1 - tail)) tail++;
  return { start, removed: before.slice(start, before.length - tail), added: after.slice(start, after.length - tail) };
}

// Adds a step to the last one if it continues the same word or deletion; returns false otherwise.
function mergeStep(last, { start, removed, added, kind }) {
  if (last?.kind !== kind) return false;
  if (kind === "insertText" && !removed && start === last.start + last.added.length && !(/\s$/.test(last.added) && /^\S/.test(added))) last.added += added;
  else if (kind === "deleteContentBackward" && !added && start + removed.length === last.start) Object.assign(last, { start, removed: removed + last.removed });
  else if (kind === "deleteContentForward" && !added && start === last.start) last.removed += removed;
  else return false;
  return true;
}
