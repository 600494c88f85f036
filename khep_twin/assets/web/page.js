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

// Sets a text; an unchanged one costs no layout.
export function setText(node, text) {
  if (node.textContent !== `${text}`) node.textContent = text;
}
