// A page that plays finished runs, from the packed samples in it: their time line, keys and address.

import { $, createTable, setText } from "./page.js";
import { decodeBase64, unpack } from "./replay.js";
import { RunView } from "./run_view.js";

const FRAME = 0.03; // shortest time between two pictures [s]
const SNAP = 6; // distance at which the slider goes to a contact or event [px]
const THUMB = 8; // half width of the slider's thumb [px]

const KEYS = [
  ["Space", "play or pause"],
  [", .", "one sample back or ahead"],
  ["← →", "one second back or ahead, with Shift ten; in 3-D, on the slider only"],
  ["[ ]", "previous or next contact or event"],
  ["Home, End", "start or end of the run"],
  ["L", "start again at the end"],
  ["3, F", "plan or 3-D; in 3-D, follow the robot: drag, or the arrows, to orbit, with Shift or the right button to move"],
  ["wheel, two fingers, + − 0", "zoom; drag to move the view"],
  ["click on a robot", "show its sensors and motors"],
];

class Player {
  time = 0;
  isPlaying = false;
  #clockTime = 0; // of the last frame [ms]
  #shownTime = -1;

  constructor(replays) {
    this.end = Math.max(...replays.map(({ end }) => end), 1e-3);
    this.marks = [...new Set(replays.flatMap(({ marks }) => marks))].sort((a, b) => a - b);
    $("#runs").classList.toggle("several", replays.length > 1);
    const logs = document.querySelectorAll("script.log");
    const actions = { seek: (time) => this.pauseAt(time), showDialog, onRobot: () => this.#show(true) };
    this.views = replays.map((replay, index) => new RunView(replay, logs[index], actions));
    $("#runs").append(...this.views.map(({ root }) => root));
    for (const view of this.views) view.fit();
    $("#slider").max = this.end;
    if (!replays.some(({ scene }) => scene)) for (const id of ["zoom-out-button", "fit", "zoom-in-button", "solids"]) $(`#${id}`).hidden = true;
    this.#connect();
    new ResizeObserver(() => this.#drawMarks(replays)).observe($("#marks"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => (this.#drawMarks(replays), this.views.forEach((view) => view.reload())));
    addEventListener("hashchange", () => this.#readHash());
    const isAt = this.#readHash();
    requestAnimationFrame((now) => this.#frame(now));
    if (!isAt && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.setPlaying(true);
  }

  setPlaying(isPlaying) {
    if (isPlaying && this.time >= this.end) this.#seek(0);
    this.isPlaying = isPlaying;
    $("#play").setAttribute("aria-pressed", isPlaying);
    setText($("#play span"), isPlaying ? "Pause" : "Play");
    $("#play use").setAttribute("href", isPlaying ? "#pause" : "#run");
    if (isPlaying) return;
    this.#show(true);
    this.#report();
  }

  pauseAt(time) {
    if (this.isPlaying) this.setPlaying(false);
    this.#seek(time);
    this.#report();
  }

  #seek(time) {
    this.time = Math.min(Math.max(time, 0), this.end);
    this.#show(true);
  }

  #show(isJump) {
    this.#shownTime = this.time;
    for (const view of this.views) view.show(this.time, isJump);
    setText($("#clock"), `${this.time.toFixed(2)} s`);
    $("#slider").value = this.time;
    $("#slider").setAttribute("aria-valuetext", `${this.time.toFixed(2)} of ${this.end.toFixed(2)} s`);
  }

  #frame(now) {
    if (this.isPlaying) {
      this.time += (Math.min(now - this.#clockTime, 250) / 1e3) * +$("#speed").value;
      if (this.time >= this.end) {
        const isLooping = $("#loop").getAttribute("aria-pressed") === "true";
        if (isLooping) this.#seek(0);
        else {
          this.time = this.end;
          this.#show(false);
          this.setPlaying(false);
        }
      } else if (this.time - this.#shownTime >= FRAME * Math.min(+$("#speed").value, 1)) this.#show(false);
    }
    this.#clockTime = now;
    requestAnimationFrame((next) => this.#frame(next));
  }

  // Tells screen readers the state, and writes the moment to the address.
  #report() {
    setText($("#status"), this.views.map((view) => view.describe()).join("; "));
    try {
      history.replaceState(null, "", `#${new URLSearchParams({ t: +this.time.toFixed(3), robot: this.views[0].robot.name })}`);
    } catch {
      // The address of a frame in another page cannot be changed.
    }
  }

  // Goes to the moment in the address; returns whether it has one.
  #readHash() {
    const values = new URLSearchParams(location.hash.slice(1));
    for (const view of this.views) view.choose(values.get("robot"));
    const time = values.has("t") ? parseFloat(values.get("t")) : NaN;
    if (!Number.isFinite(time)) return this.#show(true), false;
    this.setPlaying(false);
    this.#seek(time);
    return true;
  }

  #goToMark(step) {
    const marks = step > 0 ? this.marks.filter((mark) => mark > this.time + 1e-6) : this.marks.filter((mark) => mark < this.time - 1e-6).reverse();
    this.pauseAt(marks[0] ?? (step > 0 ? this.end : 0));
  }

  #connect() {
    const view = this.views[0];
    const step = (direction) => this.pauseAt(view.replay.neighbour(this.time, direction));
    const all = (act) => () => this.views.forEach(act);
    const loop = () => $("#loop").setAttribute("aria-pressed", $("#loop").getAttribute("aria-pressed") !== "true");
    const solids = () => {
      const isShown = $("#solids").getAttribute("aria-pressed") !== "true";
      const succeeded = this.views.filter((item) => item.replay.scene).map((item) => item.setSolid(isShown));
      if (isShown && !succeeded.some((result) => result)) return setText($("#status"), "This browser has no WebGL.");
      $("#solids").setAttribute("aria-pressed", isShown);
      $("#follow-button").hidden = !isShown;
      this.#show(true);
    };
    const follow = () => this.views.forEach((item) => $("#follow-button").setAttribute("aria-pressed", item.toggleFollow()));
    const actions = {
      play: () => this.setPlaying(!this.isPlaying),
      back: () => step(-1),
      ahead: () => step(1),
      previous: () => this.#goToMark(-1),
      next: () => this.#goToMark(1),
      loop,
      solids,
      "follow-button": follow,
      keys: () => showDialog("Keys", createTable(KEYS)),
      fit: all((item) => item.zoom("0")),
      "zoom-in-button": all((item) => item.zoom("+")),
      "zoom-out-button": all((item) => item.zoom("-")),
    };
    for (const [id, act] of Object.entries(actions)) $(`#${id}`).addEventListener("click", act);
    const views = { 3: "solids", f: "follow-button", 0: "fit", "+": "zoom-in-button", "=": "zoom-in-button", "-": "zoom-out-button" };
    const keys = { " ": "play", ",": "back", ".": "ahead", "[": "previous", "]": "next", l: "loop", "?": "keys", ...views };
    $("#slider").addEventListener("input", () => {
      const perPixel = this.end / Math.max($("#slider").clientWidth - 2 * THUMB, 1);
      const time = +$("#slider").value;
      const nearest = this.marks.reduce((best, mark) => (Math.abs(mark - time) < Math.abs(best - time) ? mark : best), Infinity);
      if (this.isPlaying) this.setPlaying(false);
      this.#seek(Math.abs(nearest - time) <= SNAP * perPixel ? nearest : time);
    });
    for (const kind of ["change", "pointerup"]) $("#slider").addEventListener(kind, () => this.#report());
    document.addEventListener("keydown", (event) => {
      const { key, target, shiftKey } = event;
      if ($("#dialog").open || event.ctrlKey || event.metaKey || event.altKey) return;
      if (target.matches("select, pre, input[type=checkbox]") || (target.matches("button") && [" ", "Enter"].includes(key))) return;
      const isSolid = target.matches(".solid") && this.views.find(({ root }) => root.contains(target)).handleKey(event);
      const seconds = { ArrowLeft: -1, ArrowRight: 1, ArrowDown: -1, ArrowUp: 1, PageDown: -10, PageUp: 10 }[key];
      if (isSolid) event.preventDefault();
      else if (seconds && (target === $("#slider") || key === "ArrowLeft" || key === "ArrowRight")) this.pauseAt(this.time + seconds * (shiftKey ? 10 : 1));
      else if (key === "Home" || key === "End") this.pauseAt(key === "End" ? this.end : 0);
      else if (keys[key.toLowerCase()]) $(`#${keys[key.toLowerCase()]}`).click();
      else return;
      event.preventDefault();
    });
  }

  // Draws contacts as bars and events as diamonds above the slider.
  #drawMarks(replays) {
    const canvas = $("#marks");
    const [width, scale] = [canvas.clientWidth, devicePixelRatio];
    [canvas.width, canvas.height] = [width * scale, 14 * scale];
    const pen = canvas.getContext("2d");
    const style = getComputedStyle(document.documentElement);
    const x = (time) => THUMB + (time / this.end) * (width - 2 * THUMB);
    pen.scale(scale, scale);
    for (const { events, contacts } of replays) {
      pen.fillStyle = style.getPropertyValue("--red");
      for (const [, start, end] of contacts) pen.fillRect(x(start) - 1, 7, Math.max(x(end) - x(start), 2), 7);
      for (const [time, , , topic] of events) {
        pen.fillStyle = style.getPropertyValue(topic === "/events" ? "--blue" : "--orange");
        pen.fill(new Path2D(`M${x(time)} 0l3.5 3.5l-3.5 3.5l-3.5 -3.5Z`));
      }
    }
  }
}

function showDialog(title, ...body) {
  $("#dialog h2").textContent = title;
  $("#dialog .body").replaceChildren(...body);
  $("#dialog").showModal();
  $("#dialog h2").focus(); // from there the text is read, and scrolled
}

async function start() {
  try {
    const packed = [...document.querySelectorAll("script.packed")];
    const replays = await Promise.all(packed.map((node) => unpack(decodeBase64(node.textContent))));
    window.player = new Player(replays);
    document.documentElement.dataset.ready = "yes";
  } catch (error) {
    const reason = typeof DecompressionStream === "undefined" ? "expected a browser of 2023 or later" : error.message;
    Object.assign($("#problem"), { textContent: `The run cannot be shown: ${reason}`, hidden: false });
  }
}

start();
