// Robots of a running twin moved by hand, and lamps switched.

import { post } from "./api.js";
import { place } from "./drawing.js";
import { Hands } from "./hands.js";
import { angle, tidy } from "./model.js";

const $ = (selector) => document.querySelector(selector);
const number = (selector) => ($(selector).value === "" ? null : $(selector).valueAsNumber);

export class Handling {
  hands = new Hands();
  #held = null;

  constructor(running) {
    this.running = running;
    const press = () => this.#put(running.which, number("#put-x"), number("#put-y"), number("#put-h"));
    $("#put").addEventListener("click", () => running.attempt(press, "hand"));
  }

  // Index of the robot that is held.
  get held() {
    return this.#held?.index;
  }

  // Offers a switch for each of so many lamps.
  lamps(count) {
    const switches = Array.from({ length: count }, (_, index) => {
      const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: true });
      box.addEventListener("change", () => this.#switch(index, box.checked));
      const label = document.createElement("label");
      label.append(box, ` lamp ${index + 1}`);
      return label;
    });
    $("#switches").replaceChildren(...switches);
  }

  // Takes the lamps of a picture, as others may have switched them.
  told(lamps) {
    lamps.forEach(({ off }, index) => {
      const box = $(`#switches label:nth-child(${index + 1}) input`);
      if (box && box !== document.activeElement) box.checked = !off;
    });
  }

  // Puts a robot to a place; undo puts it back to where it was lifted from, or else to where it is now.
  #put(robot, x_mm, y_mm, heading_deg, from = this.running.last?.robots[robot]) {
    const to = ({ x_mm, y_mm, heading_deg }) => ["put", { robot, x_mm, y_mm, heading_deg }];
    return this.hands.do(to({ x_mm, y_mm, heading_deg }), from && to(from));
  }

  #switch(lamp, on) {
    return this.running.attempt(() => this.hands.do(["switch", { lamp, on }], ["switch", { lamp, on: !on }]), "hand");
  }

  // Lifts a robot or puts it down; a click on a lamp switches it. Returns whether the pointer hit one of them.
  down(event, at, target) {
    if (this.running.real || !this.running.last || event.button !== 0) return false;
    const live = target?.closest?.(".live");
    const lamp = target?.dataset.id?.match(/^lamp:(\d+)$/);
    if (lamp) {
      const off = this.running.last?.lamps[+lamp[1]]?.off;
      this.#switch(+lamp[1], off === true);
      return true;
    }
    if (!live) return false;
    const index = +live.dataset.live;
    const { x_mm, y_mm, heading_deg } = this.running.last.robots[index];
    this.#held = { index, at, from: [x_mm, y_mm], lifted: this.running.last.robots[index], x_mm, y_mm, heading_deg, node: live };
    live.classList.add("held");
    this.running.show(index);
    return true;
  }

  move(_, at) {
    const held = this.#held;
    if (!held || held.down) return;
    held.x_mm = held.from[0] + at[0] - held.at[0];
    held.y_mm = held.from[1] + at[1] - held.at[1];
    place(held.node, held);
    this.#ask(held);
  }

  // Asks if a held robot has room at its position: one question at a time.
  #ask(held) {
    held.moved = true;
    if (held.asked) return;
    Object.assign(held, { asked: true, moved: false });
    this.running.attempt(() => post("room", { robot: held.index, x_mm: held.x_mm, y_mm: held.y_mm }), "room");
  }

  room({ robot, reason }) {
    const held = this.#held;
    if (held?.index !== robot || !held.asked) return;
    held.asked = false;
    held.node.classList.toggle("bad", reason !== "");
    this.running.drawing.reasons(reason ? [[[held.x_mm, held.y_mm], reason]] : []);
    if (held.moved && !held.down) this.#ask(held);
  }

  turn(degrees) {
    if (!this.#held || this.#held.down) return false;
    this.#held.heading_deg += degrees;
    place(this.#held.node, this.#held);
    return true;
  }

  up() {
    const held = this.#held;
    if (!held || held.down) return;
    held.down = true; // and stays where it was let go until the twin has answered
    held.node.classList.remove("held");
    const { index } = held;
    const [x_mm, y_mm, heading_deg] = [tidy(held.x_mm), tidy(held.y_mm), angle(held.heading_deg)];
    this.running.attempt(async () => {
      try {
        if (Math.hypot(x_mm - held.from[0], y_mm - held.from[1]) > 1 || heading_deg !== this.running.last.robots[index].heading_deg)
          await this.#put(index, x_mm, y_mm, heading_deg, held.lifted);
      } finally {
        held.node.classList.remove("bad");
        this.running.drawing.reasons([]);
        this.#held = null;
      }
    }, "hand");
  }
}
