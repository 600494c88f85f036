// The running twin in the plan: its robots, their paths and fields of view, its lamps, and objects that move.

import { closed, make, place } from "./drawing.js";
import { OBJECTS } from "./model.js";

// Path of a robot so far: of many short paths only the last is drawn anew.
class Trail {
  node = make("g");
  places = []; // the newest
  #last = null;
  #path = null;
  #points = [];

  add(x, y) {
    const way = this.#last ? Math.hypot(this.#last[0] - x, this.#last[1] - y) : Infinity;
    if (way <= 3) return;
    // After a jump, when the user has moved the robot, a new path begins.
    if (way > 150 || this.#points.length >= 60) {
      this.#points = way > 150 ? [] : [this.#last];
      this.#path = make("path", { class: "trail" });
      this.node.append(this.#path);
      if (this.node.childElementCount > 25) this.node.firstChild.remove();
    }
    this.#last = [x, y];
    this.#points.push(this.#last);
    if (this.places.push(this.#last) > 1500) this.places.shift();
    this.#path.setAttribute("d", `M${this.#points.map((point) => point.join(" ")).join("L")}`);
  }
}

// A beam of 30 degrees, as long as an ultrasonic sensor reads.
function sector(reach) {
  const [x, y] = [reach * Math.cos(Math.PI / 12), reach * Math.sin(Math.PI / 12)];
  return `M0 0L${x} ${-y}A${reach} ${reach} 0 0 1 ${x} ${y}Z`;
}

// An LED of three colours, 0 to 63 each.
function shine(led, parts) {
  const most = Math.max(...parts);
  led.setAttribute("visibility", most ? "visible" : "hidden");
  if (most) led.setAttribute("fill", `rgb(${parts.map((part) => Math.round((255 * part) / most))})`);
}

export class LivePlan {
  #trails = [];
  #nodes = null; // of the robots, while they are drawn

  constructor(drawing) {
    this.drawing = drawing;
  }

  // Takes the number of robots of another twin, which have been nowhere yet.
  begin(count) {
    this.#trails = Array.from({ length: count }, () => new Trail());
  }

  end() {
    this.#nodes = null;
    this.drawing.live.replaceChildren();
  }

  // Places where a robot has been.
  places(index) {
    return this.#trails[index].places;
  }

  // Draws the robots anew, at their places in the last picture.
  draw(robots, last) {
    const { drawing } = this;
    this.#nodes = robots.map((robot, index) => {
      const node = drawing.robot(null, robot.turrets, robot);
      const rays = robot.sensors.map(([x, y, heading]) => {
        const fan = make("path", { class: "ray", d: "M0 0L40 -14A42 42 0 0 1 40 14Z", transform: `translate(${x} ${y}) rotate(${heading})`, opacity: 0.06 });
        node.prepend(fan);
        return fan;
      });
      const beams = robot.sonar.map(([x, y, heading]) => {
        const beam = make("path", { class: "ray", transform: `translate(${x} ${y}) rotate(${heading})`, opacity: 0.12 });
        node.prepend(beam);
        return beam;
      });
      const leds = (robot.leds_mm ?? []).map(([cx, cy]) => make("circle", { cx, cy, r: 4, visibility: "hidden" }));
      node.append(...leds);
      node.classList.add("live", "thing");
      node.dataset.live = index;
      if (last) place(node, last.robots[index]);
      return { node, rays, beams, leds, turrets: node.querySelectorAll(".turret") };
    });
    drawing.live.replaceChildren(...this.#trails.map(({ node }) => node), ...this.#nodes.map(({ node }) => node));
  }

  // Takes a picture; a held robot is where the user holds it, and of a hidden plan only the paths go on.
  picture(message, held, hidden) {
    if (!this.#nodes) return;
    message.robots.forEach((robot, index) => {
      const { node, rays, beams, leds, turrets } = this.#nodes[index] ?? {};
      if (!node) return;
      this.#trails[index].add(robot.x_mm, robot.y_mm);
      if (hidden) return;
      if (held !== index) place(node, robot);
      robot.turrets.forEach((points, part) => turrets[part]?.setAttribute("d", closed(points)));
      robot.more?.ultrasonic?.forEach((cm, sensor) => beams[sensor].setAttribute("d", cm && cm < 1000 ? sector(10 * cm) : ""));
      if (robot.leds.length === 3 * leds.length) leds.forEach((led, each) => shine(led, robot.leds.slice(3 * each, 3 * each + 3)));
      robot.proximity.forEach((count, sensor) => rays[sensor]?.setAttribute("opacity", 0.05 + (0.6 * count) / 1023));
    });
    message.lamps.forEach(({ power_w }, index) => this.drawing.nodes.get(`lamp:${index}`)?.classList.toggle("off", power_w === 0));
    for (const kind of Object.keys(OBJECTS))
      for (const [index, [x_mm, y_mm, angle_deg]] of Object.entries(message.objects[kind])) {
        const node = this.drawing.nodes.get(`${kind}:${index}`);
        if (node) place(node, { x_mm, y_mm, angle_deg });
      }
  }
}
