// Banners of the page, and actions whose errors they show.

import { $, create } from "./page.js";

// A banner replaces the previous one about the same subject. An error stays until its action has succeeded.
export function banner(text, kind = "", choices = {}, about = text) {
  [...$("#banners").children].find((other) => other.dataset.about === about)?.remove();
  const box = create("div", { className: `banner ${kind}` }, create("span", {}, text));
  box.dataset.about = about;
  const close = () => box.remove();
  for (const [name, act] of Object.entries(choices)) {
    const button = create("button", {}, name);
    button.addEventListener("click", () => {
      close();
      attempt(act, about);
    });
    box.append(button);
  }
  const closeButton = create("button", { title: "Close" }, "×");
  closeButton.addEventListener("click", close);
  box.append(closeButton);
  $("#banners").append(box);
  // Banners that offer a choice are not removed.
  if ($("#banners").children.length > 4) [...$("#banners").children].find((other) => other.childElementCount === 2)?.remove();
  if (!Object.keys(choices).length && (kind !== "error" || about === "hand")) setTimeout(close, 8000);
  return close;
}

// Removes the errors about a subject.
export function settle(about) {
  for (const error of findErrors(about)) error.remove();
}

function findErrors(about) {
  return [...document.querySelectorAll(".banner.error")].filter((error) => error.dataset.about === about);
}

// Runs an action and shows its error; its success removes earlier errors about the same subject.
export async function attempt(act, about) {
  // Errors shown meanwhile, for example of a twin that does not start, stay.
  const previousErrors = findErrors(about);
  try {
    const result = await act();
    for (const error of previousErrors) error.remove();
    return result;
  } catch (error) {
    // The loss of the designer is reported once, elsewhere.
    if (!error.isUnreachable) banner(error.message, "error", {}, about);
    document.dispatchEvent(new CustomEvent("failed", { detail: { about, text: error.message } }));
    return undefined;
  }
}
