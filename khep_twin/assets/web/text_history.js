// The history of a text: what was typed word by word, and other edits one by one.

const LIMIT = 1000; // steps

export class TextHistory {
  #done = [];
  #undone = [];

  constructor(text) {
    this.text = text;
  }

  // Takes the text after an edit; `kind` is its inputType.
  record(text, kind = "") {
    const step = { ...difference(this.text, text), kind };
    if (!step.removed && !step.added) return;
    this.text = text;
    this.#undone = [];
    if (!join(this.#done.at(-1), step)) this.#done.push(step);
    if (this.#done.length > LIMIT) this.#done.shift();
  }

  // Returns where the caret comes, undefined if there is nothing to take back.
  undo() {
    return this.#go(this.#done, this.#undone, "added", "removed");
  }

  redo() {
    return this.#go(this.#undone, this.#done, "removed", "added");
  }

  #go(from, to, away, back) {
    const step = from.pop();
    if (!step) return undefined;
    to.push({ ...step, kind: "" }); // what is typed next is a step of its own
    this.text = this.text.slice(0, step.at) + step[back] + this.text.slice(step.at + step[away].length);
    return step.at + step[back].length;
  }
}

function difference(before, after) {
  const shorter = Math.min(before.length, after.length);
  let at = 0;
  while (at < shorter && before[at] === after[at]) at++;
  let end = 0;
  while (end < shorter - at && before.at(-1 - end) === after.at(-1 - end)) end++;
  return { at, removed: before.slice(at, before.length - end), added: after.slice(at, after.length - end) };
}

// Adds a step to the last one if it goes on with the same word, or deletes on.
function join(last, { at, removed, added, kind }) {
  if (last?.kind !== kind) return false;
  if (kind === "insertText" && !removed && at === last.at + last.added.length && !(/\s$/.test(last.added) && /^\S/.test(added))) last.added += added;
  else if (kind === "deleteContentBackward" && !added && at + removed.length === last.at) Object.assign(last, { at, removed: removed + last.removed });
  else if (kind === "deleteContentForward" && !added && at === last.at) last.removed += removed;
  else return false;
  return true;
}
