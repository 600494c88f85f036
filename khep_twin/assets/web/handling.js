// Manual changes to a running twin: robots are moved, lamps switched.

import { post } from "./api.js";
import { setPose } from "./drawing.js";
import { ManualHistory } from "./hands.js";
import { roundHundredths, wrapAngle } from "./model.js";
import { $, create, readNumber } from "./page.js";

export class Handling {
  history = new ManualHistory();
  #lifted = null; // the lifted robot

  constructor(running) {
    this.running = running;
    const put = () => this.#put(running.selectedIndex, readNumber("#put-x"), readNumber("#put-y"), readNumber("#put-h"));
    $("#put").addEventListener("click", () => running.attempt(put, "hand"));
  }

  // Index of the lifted robot.
  get liftedIndex() {
    return this.#lifted?.index;
  }

  // Creates a switch for each lamp.
  createSwitches(count) {
    const switches = Array.from({ length: count }, (_, index) => {
      const box = create("input", { type: "checkbox", checked: true });
      box.addEventListener("change", () => this.#switch(index, box.checked));
      return create("label", {}, box, ` lamp ${index + 1}`);
    });
    $("#switches").replaceChildren(...switches);
  }

  // Shows the lamps of a picture, which other pages may have switched.
  updateSwitches(lamps) {
    lamps.forEach(({ off }, index) => {
      const box = $(`#switches label:nth-child(${index + 1}) input`);
      if (box && box !== document.activeElement) box.checked = !off;
    });
  }

  // Lifts a robot; a click on a lamp switches it. Returns whether the pointer hit one of them.
  pointerDown(event, position, target) {
    const { isRealRobot, lastPicture } = this.running;
    if (isRealRobot || !lastPicture || event.button !== 0) return false;
    const lamp = target?.dataset.id?.match(/^lamp:(\d+)$/);
    if (lamp) {
      this.#switch(+lamp[1], lastPicture.lamps[+lamp[1]]?.off === true);
      return true;
    }
    const node = target?.closest?.(".live");
    if (!node) return false;
    const index = +node.dataset.live;
    const { x_mm, y_mm, heading_deg } = lastPicture.robots[index];
    this.#lifted = { index, pointerStart: position, start: lastPicture.robots[index], x_mm, y_mm, heading_deg, node };
    node.classList.add("held");
    this.running.selectRobot(index);
    return true;
  }

  pointerMove(position) {
    const robot = this.#lifted;
    if (!robot || robot.isPut) return;
    robot.x_mm = robot.start.x_mm + position[0] - robot.pointerStart[0];
    robot.y_mm = robot.start.y_mm + position[1] - robot.pointerStart[1];
    setPose(robot.node, robot);
    this.#requestRoom(robot);
  }

  // Puts the lifted robot down; it is shown there until the twin has answered.
  pointerUp() {
    const robot = this.#lifted;
    if (!robot || robot.isPut) return;
    robot.isPut = true;
    robot.node.classList.remove("held");
    const { index, start } = robot;
    const [x_mm, y_mm, heading_deg] = [roundHundredths(robot.x_mm), roundHundredths(robot.y_mm), wrapAngle(robot.heading_deg)];
    this.running.attempt(async () => {
      try {
        if (Math.hypot(x_mm - start.x_mm, y_mm - start.y_mm) > 1 || heading_deg !== this.running.lastPicture.robots[index].heading_deg)
          await this.#put(index, x_mm, y_mm, heading_deg, start);
      } finally {
        robot.node.classList.remove("bad");
        this.running.drawing.drawReasons([]);
        this.#lifted = null;
      }
    }, "hand");
  }

  // Rotates the lifted robot; returns false if there is none.
  rotate(degrees) {
    if (!this.#lifted || this.#lifted.isPut) return false;
    this.#lifted.heading_deg += degrees;
    setPose(this.#lifted.node, this.#lifted);
    return true;
  }

  // Shows the reply to #requestRoom: the reason why there is no room, or none.
  showRoom({ robot: index, reason }) {
    const robot = this.#lifted;
    if (robot?.index !== index || !robot.isWaiting) return;
    robot.isWaiting = false;
    robot.node.classList.toggle("bad", reason !== "");
    this.running.drawing.drawReasons(reason ? [[[robot.x_mm, robot.y_mm], reason, this.running.robots[index].radius_mm]] : []);
    if (robot.hasMoved && !robot.isPut) this.#requestRoom(robot);
  }

  // Asks if the lifted robot has room at its position: one request at a time.
  #requestRoom(robot) {
    robot.hasMoved = true;
    if (robot.isWaiting) return;
    Object.assign(robot, { isWaiting: true, hasMoved: false });
    this.running.attempt(() => post("room", { robot: robot.index, x_mm: robot.x_mm, y_mm: robot.y_mm }), "room");
  }

  // Puts a robot to a pose; undo returns it to `start`, by default its present pose.
  #put(robot, x_mm, y_mm, heading_deg, start = this.running.lastPicture?.robots[robot]) {
    const request = ({ x_mm, y_mm, heading_deg }) => ["put", { robot, x_mm, y_mm, heading_deg }];
    return this.history.do(request({ x_mm, y_mm, heading_deg }), start && request(start));
  }

  #switch(lamp, on) {
    return this.running.attempt(() => this.history.do(["switch", { lamp, on }], ["switch", { lamp, on: !on }]), "hand");
  }
}
