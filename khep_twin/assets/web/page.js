// Elements of the page: selected, read and created.

export const $ = (selector) => document.querySelector(selector);

// Returns the number in a field; null if the field is empty.
export const readNumber = (selector) => ($(selector).value === "" ? null : $(selector).valueAsNumber);

export function create(name, properties = {}, ...children) {
  const element = Object.assign(document.createElement(name), properties);
  element.append(...children);
  return element;
}

export const createRow = (...texts) => create("tr", {}, ...texts.map((textContent) => create("td", { textContent })));

// Returns a table of pairs of a heading and a text.
export const createTable = (pairs) =>
  create("table", {}, ...pairs.map(([heading, text]) => create("tr", {}, create("th", {}, heading), create("td", {}, text))));

// Sets a text; an unchanged one costs no layout.
export function setText(node, text) {
  if (node.textContent !== `${text}`) node.textContent = text;
}

// Appends output of a program to a box and scrolls to its end, unless the user has scrolled up.
export function appendOutput(box, text) {
  const isAtEnd = box.scrollTop + box.clientHeight >= box.scrollHeight - 4;
  box.hidden = false;
  box.textContent = (box.textContent + text).slice(-20000);
  if (isAtEnd) box.scrollTop = box.scrollHeight;
}

// Shows a picture in an image element.
export function showBlob(image, blob, alt) {
  URL.revokeObjectURL(image.src);
  Object.assign(image, { src: URL.createObjectURL(blob), alt, hidden: false });
}
