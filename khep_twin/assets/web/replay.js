// A finished run from packed samples (khep_twin/web/packing.py), as the messages that the server sends of a live one.

import { OBJECTS } from "./model.js";

const TIME_UNIT = 1e-5; // of packed times [s]
const [POSITION_UNIT, TURN_UNIT] = [1e-4, 1 / 32767]; // of packed poses [m]
const MOVED_MM = 3; // distance of the points of a path
const MORE = ["ultrasonic", "position", "accelerometer", "gyroscope", "battery"]; // further channels of readings
const INTEGERS = { 1: Int8Array, 2: Int16Array, 4: Int32Array };

// Returns the bytes of a text in base64.
export const decodeBase64 = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

// Returns the run in deflated bytes.
export async function unpack(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Replay(new Uint8Array(await new Response(stream).arrayBuffer()));
}

export class Replay {
  #series = new Map();

  constructor(bytes) {
    const length = new DataView(bytes.buffer).getUint32(0, true);
    Object.assign(this, JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length))));
    let offset = 4 + length;
    const read = (Kind, width, n) => {
      const values = new Kind(n);
      const target = new Uint8Array(values.buffer);
      for (let plane = 0; plane < width; plane++, offset += n) for (let row = 0; row < n; row++) target[row * width + plane] = bytes[offset + row];
      return values;
    };
    for (const { name, n, scale, widths } of this.series) {
      const steps = read(Uint32Array, 4, n);
      const times = new Float64Array(n);
      for (let row = 0, units = 0; row < n; row++) times[row] = (units += steps[row]) * TIME_UNIT;
      const columns = widths.map((width) => {
        const column = read(INTEGERS[width], width, n);
        for (let row = 1; row < n; row++) column[row] += column[row - 1]; // wraps around
        return column;
      });
      this.#series.set(name, { times, columns, scale });
    }
    this.marks = [...new Set([...this.events.map(([time]) => time), ...this.contacts.map(([, start]) => start)])].sort((a, b) => a - b);
    this.objects = Object.keys(OBJECTS).flatMap((kind) =>
      (this.draft?.[kind] ?? []).map(({ movable }, index) => ({ kind, index, body: movable ? this.#bodyIndex(`${kind}${index}`) : -1 })),
    ).filter(({ body }) => body >= 0);
    for (const robot of this.robots) robot.body = this.#bodyIndex(`${robot.name}/base`);
    this.lamps = (this.draft?.lamp ?? []).map(({ power_w, dim = 1 }) => power_w * dim);
  }

  has(robot, channel) {
    return this.#series.has(`/${robot.name}/${channel}`);
  }

  // Returns the state at a time, as a message "picture"; readings without a value yet are null.
  picture(time) {
    const bodies = this.#bodies(time);
    const robots = this.robots.map((robot) => ({ ...this.readings(robot, time), ...(bodies.length && robot.body >= 0 && planarPose(bodies[robot.body])) }));
    const objects = Object.fromEntries(Object.keys(OBJECTS).map((kind) => [kind, {}]));
    for (const { kind, index, body } of this.objects) objects[kind][index] = Object.values(planarPose(bodies[body]));
    const powers = this.#values("/lamps", time) ?? this.lamps;
    return { kind: "picture", time, robots, objects, bodies, lamps: powers.map((power_w) => ({ power_w })) };
  }

  readings(robot, time) {
    const value = (channel) => this.#values(`/${robot.name}/${channel}`, time);
    const none = (n) => Array(n).fill(null);
    const n = robot.names.length;
    const fill = (values) => values && [...values, ...none(n)].slice(0, n); // a shadow has no ground sensors
    const more = Object.fromEntries(MORE.flatMap((name) => (value(name) ? [[name, value(name)]] : [])));
    const leds = value("leds") ?? [];
    const colours = leds.length === robot.leds_mm?.length ? leds.flatMap((on) => [63 * on, 0, 0]) : leds;
    const [proximity, ambient] = ["proximity", "ambient"].map((name) => fill(value(name)) ?? none(n));
    return { proximity, ambient, speed: value("speed") ?? none(2), leds: colours, vision: value("vision"), turrets: [], more };
  }

  // Returns the points of a robot's path up to a time [mm], the last `limit` ones.
  path(robot, time, limit) {
    const series = this.#series.get("bodies");
    if (!series || robot.body < 0) return [];
    const [x, y] = series.columns.slice(7 * robot.body, 7 * robot.body + 2);
    const points = [];
    for (let row = this.#row(series, time), last = null; row >= 0 && points.length < limit; row--) {
      const point = [x[row] / 10, y[row] / 10];
      if (!last || Math.hypot(point[0] - last[0], point[1] - last[1]) > MOVED_MM) points.push((last = point));
    }
    return points.reverse();
  }

  // Returns the samples of a robot's readings in an interval, each with its time.
  samples(robot, from, to) {
    const series = ["proximity", "ambient", "speed"].map((name) => this.#series.get(`/${robot.name}/${name}`)).filter((item) => item);
    const longest = series.sort((a, b) => b.times.length - a.times.length)[0];
    if (!longest) return [];
    const times = longest.times.subarray(Math.max(this.#row(longest, from), 0), this.#row(longest, to) + 1);
    return [...times].map((time) => ({ time, robots: [this.readings(robot, time)] }));
  }

  // Returns the time of the next or previous sample of any robot.
  neighbour(time, step) {
    const series = this.#series.get("bodies") ?? [...this.#series.values()][0];
    const row = this.#row(series, time + 1e-9);
    const next = series.times[row] < time - 1e-9 && step < 0 ? row : row + step;
    return series.times[Math.min(Math.max(next, 0), series.times.length - 1)];
  }

  // Returns the lines of a robot's transcript up to a time, the last `limit` ones.
  lines(robot, time, limit) {
    const series = this.#series.get(`/${robot.name}/serial`);
    const end = series ? this.#row(series, time) + 1 : 0;
    const texts = this.texts[robot.name];
    const first = Math.max(end - limit, 0);
    const line = (text, row) => `${series.times[first + row].toFixed(3).padStart(8)}  ${series.columns[0][first + row] ? "  " : "> "}${text}`;
    return texts.slice(first, end).map(line);
  }

  // Returns a shadow's region at a time: centre, half axes [mm] and angle [deg], and its colour.
  region(time) {
    const values = this.#values("region", time);
    if (!values) return null;
    const state = this.events.filter(([at, , , topic]) => topic === "/shadow/state" && at <= time).at(-1)?.[2] ?? "followed";
    return { values, state, colour: this.states[state] ?? [128, 128, 128] };
  }

  #bodyIndex(name) {
    return this.scene?.bodies.indexOf(name) ?? -1;
  }

  // Returns the last row up to a time; -1 before the first.
  #row({ times }, time) {
    let [low, high] = [0, times.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time + 1e-9) low = middle + 1;
      else high = middle;
    }
    return low - 1;
  }

  #values(name, time) {
    const series = this.#series.get(name);
    const row = series ? this.#row(series, time) : -1;
    return row < 0 ? undefined : series.columns.map((column) => column[row] / series.scale);
  }

  // Returns the poses of the moving bodies; between samples more than 50 ms apart, they are interpolated.
  #bodies(time) {
    const series = this.#series.get("bodies");
    if (!series?.times.length) return [];
    const row = Math.max(this.#row(series, time), 0);
    const next = Math.min(row + 1, series.times.length - 1);
    const gap = series.times[next] - series.times[row];
    const fraction = gap > 0.05 && gap < 1.5 ? (time - series.times[row]) / gap : 0;
    const poses = [];
    for (let body = 0; body < this.scene.bodies.length; body++) {
      const pose = series.columns.slice(7 * body, 7 * body + 7).map((column) => column[row]);
      if (fraction > 0) {
        const later = series.columns.slice(7 * body, 7 * body + 7).map((column) => column[next]);
        const sign = pose[3] * later[3] + pose[4] * later[4] + pose[5] * later[5] + pose[6] * later[6] < 0 ? -1 : 1;
        pose.forEach((value, axis) => (pose[axis] += fraction * ((axis > 2 ? sign : 1) * later[axis] - value)));
      }
      const length = Math.hypot(pose[3], pose[4], pose[5], pose[6]) || 1;
      poses.push(pose.map((value, axis) => (axis < 3 ? value * POSITION_UNIT : value / length)));
    }
    return poses.map((pose, body) => (this.scene.parents[body] === null ? pose : compose(poses[this.scene.parents[body]], pose)));
  }
}

// Returns a pose in the frame of its parent in the frame of that: x, y, z and quaternion w, x, y, z.
function compose([x, y, z, w, i, j, k], [px, py, pz, pw, pi, pj, pk]) {
  const cross = ([a, b, c], [d, e, f]) => [b * f - c * e, c * d - a * f, a * e - b * d];
  const turn = cross([i, j, k], [px, py, pz]).map((value) => 2 * value);
  const twist = cross([i, j, k], turn);
  const [ci, cj, ck] = cross([i, j, k], [pi, pj, pk]);
  const position = [x + px + w * turn[0] + twist[0], y + py + w * turn[1] + twist[1], z + pz + w * turn[2] + twist[2]];
  return [...position, w * pw - i * pi - j * pj - k * pk, w * pi + pw * i + ci, w * pj + pw * j + cj, w * pk + pw * k + ck];
}

function planarPose([x, y, , w, i, j, k]) {
  return { x_mm: 1e3 * x, y_mm: 1e3 * y, heading_deg: (Math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k)) * 180) / Math.PI };
}
