// Light and shadow on the floor in 3-D: a pool of light around each lamp, with the shadows in it, and a soft shadow
// around the foot of what stands there. All of it is colours of corners, which cost little where a processor draws.

import { AdditiveBlending, BufferAttribute, BufferGeometry, Color, Float32BufferAttribute, Group, Mesh, NormalBlending, ShaderMaterial } from "./three.min.js";

const [RAYS, RINGS] = [144, 16];
const NEAR = 0.1; // distance at which a pool has half of its light, for 7 W [m]
const FAR = 3.5; // end of a pool, in such distances
const DARK = 0.002;
const RIM = 0.014; // width of a soft edge [m]
const [LIGHT, SHADE] = [0.5, 0.35];
const [LOW, HIGH] = [0.007, 0.015]; // what stands begins below and ends above these heights [m]
const [SHADE_Z, POOL_Z] = [0.0001, 0.00015]; // below the lines on the floor [m]
const SLOW = 45; // longest usual time of a frame, beyond which there is neither [ms]
const FRAMES = 40;

const CORNER = `
attribute vec4 color;
uniform vec3 tint;
varying vec4 seen;
void main() {
  seen = vec4(pow(tint, vec3(0.4545)) * color.rgb, color.a);
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;

const PIXEL = `
varying vec4 seen;
void main() { gl_FragColor = seen; }`;

// A pixel costs nothing but its colour, as in lit.js.
const material = (blending) => new ShaderMaterial({ uniforms: { tint: { value: new Color() } }, vertexShader: CORNER, fragmentShader: PIXEL, blending, transparent: true, depthWrite: false });

const turn = ([, , , w, i, j, k]) => Math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k));

// Feet of the shapes of a body that stand on the floor when it is at this height, in the frame of the body.
function feet(shapes, z = 0) {
  const standing = shapes.filter(({ kind }) => kind === "box" || kind === "cylinder").map(({ kind, size, pose }) => {
    const half = size[kind === "box" ? 2 : 1];
    const foot = { x: pose[0], y: pose[1], turned: turn(pose), bottom: z + pose[2] - half, top: z + pose[2] + half };
    return kind === "box" ? { ...foot, length: size[0], width: size[1] } : { ...foot, radius: size[0] };
  });
  return standing.filter(({ bottom, top }) => bottom < LOW && top > HIGH);
}

// A foot of a body that is at a place now.
function moved(foot, [x, y], turned) {
  const [c, s] = [Math.cos(turned), Math.sin(turned)];
  return { ...foot, x: x + c * foot.x - s * foot.y, y: y + s * foot.x + c * foot.y, turned: turned + foot.turned };
}

// Where a ray enters a foot and leaves it; null if it misses it, or begins in it.
function crossing({ x, y, turned, radius, length, width }, [fromX, fromY], along) {
  const [c, s] = [Math.cos(turned), Math.sin(turned)];
  const [dx, dy] = [fromX - x, fromY - y];
  const [px, py] = [c * dx + s * dy, c * dy - s * dx];
  const [ux, uy] = [Math.cos(along - turned), Math.sin(along - turned)];
  let [first, last] = [-Infinity, Infinity];
  if (radius) {
    const nearest = -(px * ux + py * uy);
    const half = Math.sqrt(radius * radius - (px * px + py * py) + nearest * nearest);
    [first, last] = [nearest - half, nearest + half]; // NaN if it misses
  } else
    for (const [p, u, size] of [[px, ux, length], [py, uy, width]]) {
      const [a, b] = [(-size - p) / u, (size - p) / u];
      [first, last] = [Math.max(first, Math.min(a, b)), Math.min(last, Math.max(a, b))];
    }
  return first < last && first > 0 ? [first, last] : null;
}

// Pool of light around a lamp: a disc of rays and rings, which is dark where something hides the lamp.
class Pool {
  #still = new Float32Array(RAYS * RINGS);

  constructor({ pose: [x, y, z], size, lit }, power, still) {
    Object.assign(this, { at: [x, y], height: Math.max(z - size[0], 0.001), lit, power });
    const near = NEAR * Math.sqrt(power / 7);
    this.reach = near * FAR;
    const places = new Float32BufferAttribute(3 * RAYS * RINGS, 3);
    const parts = [];
    for (let ray = 0; ray < RAYS; ray++)
      for (let ring = 0; ring < RINGS; ring++) {
        const [vertex, radius, along] = [ray * RINGS + ring, (this.reach * ring) / (RINGS - 1), (2 * Math.PI * ray) / RAYS];
        places.setXYZ(vertex, x + radius * Math.cos(along), y + radius * Math.sin(along), POOL_Z);
        this.#still[vertex] = (LIGHT * (1 - (ring / (RINGS - 1)) ** 2) ** 2) / (1 + (radius * radius + z * z) / (near * near));
        const next = ((ray + 1) % RAYS) * RINGS + ring;
        if (ring) parts.push([vertex - 1, vertex, next], [vertex - 1, next, next - 1]);
      }
    this.#hide(this.#still, still);
    // What is always dark is not drawn.
    const index = parts.filter((part) => part.some((vertex) => this.#still[vertex] > DARK)).flat();
    this.colours = new BufferAttribute(new Uint8Array(3 * RAYS * RINGS), 3, true);
    const geometry = new BufferGeometry().setIndex(index).setAttribute("position", places).setAttribute("color", this.colours);
    this.node = new Mesh(geometry, material(AdditiveBlending));
    this.node.renderOrder = 1;
    this.shine(power);
    this.move([]);
  }

  shine(power) {
    this.node.material.uniforms.tint.value.copy(this.lit).multiplyScalar(power / this.power);
  }

  // Takes what may hide the lamp and moves.
  move(moving) {
    const light = this.#still.slice();
    this.#hide(light, moving);
    light.forEach((value, vertex) => this.colours.array.fill(255 * value, 3 * vertex, 3 * vertex + 3));
    this.colours.needsUpdate = true;
  }

  dispose() {
    this.node.geometry.dispose();
    this.node.material.dispose();
    this.node.removeFromParent();
  }

  #hide(light, feet) {
    for (const foot of feet) {
      if (Math.hypot(foot.x - this.at[0], foot.y - this.at[1]) > this.reach + (foot.radius ?? foot.length + foot.width)) continue;
      for (let ray = 0; ray < RAYS; ray++) {
        const found = crossing(foot, this.at, (2 * Math.PI * ray) / RAYS);
        if (!found) continue;
        // Behind what is lower than the lamp, its light reaches the floor again.
        const end = foot.top < this.height ? (found[1] * this.height) / (this.height - foot.top) : Infinity;
        const [from, to] = [found[0], end].map((radius) => (radius * (RINGS - 1)) / this.reach);
        light.fill(0, ray * RINGS + Math.min(Math.ceil(from), RINGS), ray * RINGS + Math.min(Math.ceil(to), RINGS));
      }
    }
  }
}

// Soft shadows around feet, as one mesh.
function shadows(feet, material) {
  const [places, colours, index] = [[], [], []];
  for (const { x, y, turned, radius, length, width } of feet) {
    const corners = radius
      ? Array.from({ length: 32 }, (_, each) => [Math.cos(each * Math.PI / 16), Math.sin(each * Math.PI / 16)]).map(([c, s]) => [radius * c, radius * s, c, s])
      : [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([a, b]) => [a * length, b * width, a, b]);
    const first = places.length / 3;
    const [c, s] = [Math.cos(turned), Math.sin(turned)];
    for (const edge of [0, RIM])
      for (const [a, b, outA, outB] of corners) {
        const [along, across] = [a + edge * outA, b + edge * outB];
        places.push(x + c * along - s * across, y + s * along + c * across, SHADE_Z);
        colours.push(0, 0, 0, edge ? 0 : SHADE);
      }
    const count = corners.length;
    for (let each = 0; each < count; each++) {
      const [a, b] = [first + each, first + ((each + 1) % count)];
      index.push(a, a + count, b + count, a, b + count, b);
      if (radius) index.push(a, b, first); // there is light below a robot
    }
  }
  const geometry = new BufferGeometry().setIndex(index);
  geometry.setAttribute("position", new Float32BufferAttribute(places, 3)).setAttribute("color", new Float32BufferAttribute(colours, 4));
  return new Mesh(geometry, material);
}

export class Shades {
  node = new Group();
  #material = material(NormalBlending);
  #lamps = [];
  #still = [];
  #pools = []; // of the lamps, each from its first light on
  #bodies = [];
  #times = [];

  // Takes a scene, with the power of each lamp [W] and its colour.
  load({ shapes, poses }, lamps, powers) {
    for (const pool of this.#pools) pool?.dispose();
    for (const each of this.node.children) each.geometry.dispose();
    this.node.clear();
    this.node.visible = true; // until it is measured anew
    this.#times = [];
    const of = (body) => shapes.filter((shape) => shape.body === body);
    this.#still = feet(of(null));
    this.node.add(shadows(this.#still, this.#material));
    this.#bodies = poses.map((pose, body) => ({ body, feet: feet(of(body), pose[2]), at: [] })).filter(({ feet }) => feet.length);
    for (const each of this.#bodies) this.node.add((each.node = shadows(each.feet, this.#material)));
    this.#lamps = lamps;
    this.#pools = lamps.map(() => null);
    this.move(poses);
    this.shine(powers);
  }

  // Takes the poses of the bodies; what has moved casts another shadow.
  move(poses) {
    let changed = false;
    for (const each of this.#bodies) {
      const pose = poses[each.body];
      const at = [pose[0], pose[1], turn(pose)];
      if (each.at.length && Math.hypot(...at.map((value, index) => value - each.at[index])) < 0.0005) continue;
      changed = true;
      each.at = at;
      each.node.position.set(at[0], at[1], 0);
      each.node.rotation.z = at[2];
    }
    if (!changed || !this.node.visible) return;
    for (const pool of this.#pools) pool?.move(this.#moving());
  }

  #moving() {
    return this.#bodies.flatMap(({ feet, at }) => feet.map((foot) => moved(foot, at, at[2])));
  }

  // Takes the power of each lamp [W]; a lamp that becomes much brighter has a wider pool.
  shine(powers) {
    this.#lamps.forEach((lamp, index) => {
      const [pool, power] = [this.#pools[index], powers[index] ?? 0];
      if (power <= 2 * (pool?.power ?? 0)) return void pool?.shine(power);
      pool?.dispose();
      const wider = (this.#pools[index] = new Pool(lamp, power, this.#still));
      wider.move(this.#moving());
      this.node.add(wider.node);
    });
  }

  // Takes the time of a frame [ms]: on a slow machine there is neither light nor shadow.
  measure(time) {
    if (!this.node.visible || this.#times.push(time) < FRAMES) return;
    this.node.visible = this.#times.sort((a, b) => a - b)[FRAMES / 2] < SLOW;
    this.#times = [];
  }
}
