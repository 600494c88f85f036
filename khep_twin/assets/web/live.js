// The running twin in the plan: robots with their paths and fields of view, lamps, and movable objects.

import { closedPath, createSvg, setPose } from "./drawing.js";
import { OBJECTS } from "./model.js";

export class LivePlan {
  #trails = [];
  #nodes = null; // of the robots; null while no twin runs

  // `limit` is the number of points of a path, the newest ones.
  constructor(drawing, limit = 1500) {
    Object.assign(this, { drawing, limit });
  }

  // Clears the paths for another twin with this number of robots.
  clear(count) {
    this.#trails = Array.from({ length: count }, () => new Trail(this.limit));
  }

  // Adds the points of each robot's path before this page was opened.
  addPaths(paths) {
    paths.forEach((points, index) => points.forEach(([x, y]) => this.#trails[index]?.add(x, y)));
  }

  // Replaces the paths.
  showPaths(paths) {
    this.clear(paths.length);
    this.addPaths(paths);
    this.#showNodes();
  }

  end() {
    this.#nodes = null;
    this.drawing.liveGroup.replaceChildren();
  }

  // Returns the points of a robot's path.
  path(index) {
    return this.#trails[index].points;
  }

  // Draws the robots, in their poses of the last picture.
  drawRobots(robots, lastPicture) {
    const { drawing } = this;
    this.#nodes = robots.map((robot, index) => {
      const node = drawing.createRobot(null, robot.turrets, robot);
      const addRays = (poses, keys) => poses.map(([x, y, heading]) => {
        const ray = createSvg("path", { class: "ray", transform: `translate(${x} ${y}) rotate(${heading})`, ...keys });
        node.prepend(ray);
        return ray;
      });
      const rays = addRays(robot.sensors, { d: "M0 0L40 -14A42 42 0 0 1 40 14Z", opacity: 0.06 });
      const beams = addRays(robot.sonar.map(([x, y, , heading]) => [x, y, heading]), { opacity: 0.12 });
      const leds = (robot.leds_mm ?? []).map(([cx, cy]) => createSvg("circle", { cx, cy, r: 4, visibility: "hidden" }));
      node.append(...leds);
      node.classList.add("live", "part");
      node.dataset.live = index;
      if (lastPicture) setPose(node, lastPicture.robots[index]);
      return { node, rays, beams, leds, robot, turrets: node.querySelectorAll(".turret") };
    });
    this.#showNodes();
  }

  #showNodes() {
    this.drawing.liveGroup.replaceChildren(...this.#trails.map(({ node }) => node), ...this.#nodes.map(({ node }) => node));
  }

  // Shows a picture; a lifted robot is where the user holds it, and in a hidden plan only the paths are updated.
  showPicture(message, liftedIndex, isHidden) {
    if (!this.#nodes) return;
    message.robots.forEach((robot, index) => {
      const { node, rays, beams, leds, robot: shape, turrets } = this.#nodes[index] ?? {};
      if (!node) return;
      this.#trails[index].add(robot.x_mm, robot.y_mm);
      if (isHidden) return;
      if (liftedIndex !== index) setPose(node, robot);
      robot.turrets.forEach((points, turretPart) => turrets[turretPart]?.setAttribute("d", closedPath(points)));
      robot.more?.ultrasonic?.forEach((reading, sensor) => beams[sensor].setAttribute("d", sectorPath(beamLength(shape, reading))));
      if (robot.leds.length === 3 * leds.length) leds.forEach((led, number) => setLed(led, robot.leds.slice(3 * number, 3 * number + 3)));
      robot.proximity.forEach((count, sensor) => rays[sensor]?.setAttribute("opacity", 0.05 + 0.6 * Math.min(Math.max(count / shape.bars.proximity.full, 0), 1)));
    });
    message.lamps.forEach(({ power_w }, index) => this.drawing.nodes.get(`lamp:${index}`)?.classList.toggle("off", power_w === 0));
    for (const kind of Object.keys(OBJECTS))
      for (const [index, [x_mm, y_mm, angle_deg]] of Object.entries(message.objects[kind])) {
        const node = this.drawing.nodes.get(`${kind}:${index}`);
        if (node) setPose(node, { x_mm, y_mm, angle_deg });
      }
  }
}

// Path of a robot so far, in many short SVG paths, of which only the last changes.
class Trail {
  node = createSvg("g");
  points = []; // the newest positions
  #last = null;
  #path = null;
  #text = ""; // of the last SVG path
  #pathCount = 0; // points of the last SVG path

  constructor(limit) {
    this.limit = limit;
  }

  add(x, y) {
    const distance = this.#last ? Math.hypot(this.#last[0] - x, this.#last[1] - y) : Infinity;
    if (distance <= 3) return;
    // A jump, when the user has moved the robot, starts a new path.
    if (distance > 150 || this.#pathCount >= 60) {
      this.#text = distance > 150 ? "" : `M${this.#last.join(" ")}`;
      this.#pathCount = 0;
      this.#path = createSvg("path", { class: "trail" });
      this.node.append(this.#path);
      if (this.node.childElementCount > this.limit / 60) this.node.firstChild.remove();
    }
    this.#last = [x, y];
    this.#pathCount++;
    this.#text += `${this.#text ? "L" : "M"}${x} ${y}`;
    if (this.points.push(this.#last) > this.limit) this.points.shift();
    this.#path.setAttribute("d", this.#text);
  }
}

// Returns the distance that a reading of a robot's ultrasonic sensor means [mm]; 0 without one.
export const beamLength = ({ sonar_codes: codes, sonar_unit_mm: unit }, reading) => (codes.includes(reading) ? 0 : reading * unit);

// Returns a beam of 30 degrees, with the distance that an ultrasonic sensor measures; empty for 0.
function sectorPath(distance) {
  if (!distance) return "";
  const [x, y] = [distance * Math.cos(Math.PI / 12), distance * Math.sin(Math.PI / 12)];
  return `M0 0L${x} ${-y}A${distance} ${distance} 0 0 1 ${x} ${y}Z`;
}

// Shows an LED by its channels red, green and blue, 0 to 63 each.
function setLed(led, channels) {
  const maximum = Math.max(...channels);
  led.setAttribute("visibility", maximum ? "visible" : "hidden");
  if (maximum) led.setAttribute("fill", `rgb(${channels.map((value) => Math.round((255 * value) / maximum))})`);
}
