// Light and shadow on the floor in 3-D: a pool of light around each lamp, with shadows of the objects in it, and a soft
// shadow around the footprint of each object. All are vertex colours, which cost little without a GPU.

import { AdditiveBlending, BufferAttribute, BufferGeometry, Color, Float32BufferAttribute, Group, Mesh, NormalBlending, ShaderMaterial } from "./three.min.js";

const [RAYS, RINGS] = [144, 16];
const NEAR = 0.1; // distance at which the light is halved, for a lamp of 7 W [m]
const FAR = 3.5; // radius of a pool, in such distances
const DARK = 0.002; // light that is not drawn
const SOFT_EDGE = 0.014; // width of a soft edge [m]
const [LIGHT, SHADE] = [0.5, 0.35];
const [LOW, HIGH] = [0.007, 0.015]; // an object on the floor has its bottom below and its top above these heights [m]
const [SHADE_Z, POOL_Z] = [0.0001, 0.00015]; // heights, below the lines on the floor [m]
const SLOW = 45; // median time of a frame above which light and shadow are switched off [ms]
const FRAMES = 40; // of a median

const VERTEX_SHADER = `
attribute vec4 color;
uniform vec3 tint;
varying vec4 shade;
void main() {
  shade = vec4(pow(tint, vec3(0.4545)) * color.rgb, color.a);
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;

const FRAGMENT_SHADER = `
varying vec4 shade;
void main() { gl_FragColor = shade; }`;

// Interpolates the colours of the vertices, as in lit.js.
const createMaterial = (blending) => new ShaderMaterial({ uniforms: { tint: { value: new Color() } }, vertexShader: VERTEX_SHADER, fragmentShader: FRAGMENT_SHADER, blending, transparent: true, depthWrite: false });

export class FloorShading {
  node = new Group();
  #material = createMaterial(NormalBlending);
  #lamps = [];
  #staticFootprints = [];
  #pools = []; // by lamp; null before its first light
  #bodies = [];
  #frameTimes = []; // [ms]

  // Shows a scene, with the colour of each lamp and its power [W].
  load({ shapes, poses }, lamps, powers) {
    for (const pool of this.#pools) pool?.dispose();
    for (const mesh of this.node.children) mesh.geometry.dispose();
    this.node.clear();
    this.node.visible = true; // until frames are measured again
    this.#frameTimes = [];
    const shapesOf = (body) => shapes.filter((shape) => shape.body === body);
    this.#staticFootprints = findFootprints(shapesOf(null));
    this.node.add(createShadows(this.#staticFootprints, this.#material));
    this.#bodies = poses.map((pose, body) => ({ index: body, footprints: findFootprints(shapesOf(body), pose[2]), floorPose: [] })).filter(({ footprints }) => footprints.length);
    for (const body of this.#bodies) this.node.add((body.node = createShadows(body.footprints, this.#material)));
    this.#lamps = lamps;
    this.#pools = lamps.map(() => null);
    this.setPoses(poses);
    this.setPowers(powers);
  }

  // Takes the poses of the bodies and updates the shadows of those that have moved.
  setPoses(poses) {
    let hasMoved = false;
    for (const body of this.#bodies) {
      const pose = poses[body.index];
      const floorPose = [pose[0], pose[1], yaw(pose)];
      if (body.floorPose.length && Math.hypot(...floorPose.map((value, axis) => value - body.floorPose[axis])) < 0.0005) continue;
      hasMoved = true;
      body.floorPose = floorPose;
      body.node.position.set(floorPose[0], floorPose[1], 0);
      body.node.rotation.z = floorPose[2];
    }
    if (!hasMoved || !this.node.visible) return;
    for (const pool of this.#pools) pool?.update(this.#movingFootprints());
  }

  // Takes the power of each lamp [W]; a lamp that becomes much brighter gets a wider pool.
  setPowers(powers) {
    this.#lamps.forEach((lamp, index) => {
      const [pool, power] = [this.#pools[index], powers[index] ?? 0];
      if (power <= 2 * (pool?.power ?? 0)) return void pool?.setPower(power);
      pool?.dispose();
      const newPool = (this.#pools[index] = new LightPool(lamp, power, this.#staticFootprints));
      newPool.update(this.#movingFootprints());
      this.node.add(newPool.node);
    });
  }

  // Takes the time of a frame [ms]; on a slow machine, light and shadow are switched off.
  measureFrame(time) {
    if (!this.node.visible || this.#frameTimes.push(time) < FRAMES) return;
    this.node.visible = this.#frameTimes.sort((a, b) => a - b)[FRAMES / 2] < SLOW;
    this.#frameTimes = [];
  }

  #movingFootprints() {
    return this.#bodies.flatMap(({ footprints, floorPose }) => footprints.map((footprint) => moveFootprint(footprint, floorPose, floorPose[2])));
  }
}

const yaw = ([, , , w, i, j, k]) => Math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k));

// Returns the footprints of a body's boxes and cylinders on the floor, in the frame of the body at height z.
function findFootprints(shapes, z = 0) {
  const candidates = shapes.filter(({ kind }) => kind === "box" || kind === "cylinder").map(({ kind, size, pose }) => {
    const half = size[kind === "box" ? 2 : 1];
    const footprint = { x: pose[0], y: pose[1], rotation: yaw(pose), bottom: z + pose[2] - half, top: z + pose[2] + half };
    return kind === "box" ? { ...footprint, length: size[0], width: size[1] } : { ...footprint, radius: size[0] };
  });
  return candidates.filter(({ bottom, top }) => bottom < LOW && top > HIGH);
}

// Returns a footprint in the frame of the floor, for the pose of its body.
function moveFootprint(footprint, [x, y], rotation) {
  const [c, s] = [Math.cos(rotation), Math.sin(rotation)];
  return { ...footprint, x: x + c * footprint.x - s * footprint.y, y: y + s * footprint.x + c * footprint.y, rotation: rotation + footprint.rotation };
}

// Returns the distances at which a ray enters and leaves a footprint; null if it misses it or starts in it.
function intersectRay({ x, y, rotation, radius, length, width }, [fromX, fromY], angle) {
  const [c, s] = [Math.cos(rotation), Math.sin(rotation)];
  const [dx, dy] = [fromX - x, fromY - y];
  const [px, py] = [c * dx + s * dy, c * dy - s * dx];
  const [ux, uy] = [Math.cos(angle - rotation), Math.sin(angle - rotation)];
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

// Pool of light around a lamp: a disc of rays and rings, dark where an object hides the lamp.
class LightPool {
  #staticLight = new Float32Array(RAYS * RINGS);

  constructor({ pose: [x, y, z], size, colour }, power, staticFootprints) {
    Object.assign(this, { position: [x, y], height: Math.max(z - size[0], 0.001), colour, power });
    const near = NEAR * Math.sqrt(power / 7);
    this.radius = near * FAR;
    const positions = new Float32BufferAttribute(3 * RAYS * RINGS, 3);
    const triangles = [];
    for (let ray = 0; ray < RAYS; ray++)
      for (let ring = 0; ring < RINGS; ring++) {
        const [vertex, radius, angle] = [ray * RINGS + ring, (this.radius * ring) / (RINGS - 1), (2 * Math.PI * ray) / RAYS];
        positions.setXYZ(vertex, x + radius * Math.cos(angle), y + radius * Math.sin(angle), POOL_Z);
        this.#staticLight[vertex] = (LIGHT * (1 - (ring / (RINGS - 1)) ** 2) ** 2) / (1 + (radius * radius + z * z) / (near * near));
        const next = ((ray + 1) % RAYS) * RINGS + ring;
        if (ring) triangles.push([vertex - 1, vertex, next], [vertex - 1, next, next - 1]);
      }
    this.#castShadows(this.#staticLight, staticFootprints);
    // Triangles that are always dark are not drawn.
    const index = triangles.filter((triangle) => triangle.some((vertex) => this.#staticLight[vertex] > DARK)).flat();
    this.colours = new BufferAttribute(new Uint8Array(3 * RAYS * RINGS), 3, true);
    const geometry = new BufferGeometry().setIndex(index).setAttribute("position", positions).setAttribute("color", this.colours);
    this.node = new Mesh(geometry, createMaterial(AdditiveBlending));
    this.node.renderOrder = 1;
    this.setPower(power);
    this.update([]);
  }

  setPower(power) {
    this.node.material.uniforms.tint.value.copy(this.colour).multiplyScalar(power / this.power);
  }

  // Computes the light with the shadows of moving objects.
  update(movingFootprints) {
    const light = this.#staticLight.slice();
    this.#castShadows(light, movingFootprints);
    light.forEach((value, vertex) => this.colours.array.fill(255 * value, 3 * vertex, 3 * vertex + 3));
    this.colours.needsUpdate = true;
  }

  dispose() {
    this.node.geometry.dispose();
    this.node.material.dispose();
    this.node.removeFromParent();
  }

  #castShadows(light, footprints) {
    for (const footprint of footprints) {
      if (Math.hypot(footprint.x - this.position[0], footprint.y - this.position[1]) > this.radius + (footprint.radius ?? footprint.length + footprint.width)) continue;
      for (let ray = 0; ray < RAYS; ray++) {
        const interval = intersectRay(footprint, this.position, (2 * Math.PI * ray) / RAYS);
        if (!interval) continue;
        // Behind an object lower than the lamp, the light reaches the floor again.
        const end = footprint.top < this.height ? (interval[1] * this.height) / (this.height - footprint.top) : Infinity;
        const [from, to] = [interval[0], end].map((radius) => (radius * (RINGS - 1)) / this.radius);
        light.fill(0, ray * RINGS + Math.min(Math.ceil(from), RINGS), ray * RINGS + Math.min(Math.ceil(to), RINGS));
      }
    }
  }
}

// Creates the soft shadows around footprints, as one mesh.
function createShadows(footprints, material) {
  const [positions, colours, index] = [[], [], []];
  for (const { x, y, rotation, radius, length, width } of footprints) {
    const corners = radius
      ? Array.from({ length: 32 }, (_, corner) => [Math.cos(corner * Math.PI / 16), Math.sin(corner * Math.PI / 16)]).map(([c, s]) => [radius * c, radius * s, c, s])
      : [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([a, b]) => [a * length, b * width, a, b]);
    const first = positions.length / 3;
    const [c, s] = [Math.cos(rotation), Math.sin(rotation)];
    for (const edge of [0, SOFT_EDGE])
      for (const [a, b, outA, outB] of corners) {
        const [along, across] = [a + edge * outA, b + edge * outB];
        positions.push(x + c * along - s * across, y + s * along + c * across, SHADE_Z);
        colours.push(0, 0, 0, edge ? 0 : SHADE);
      }
    const count = corners.length;
    for (let corner = 0; corner < count; corner++) {
      const [a, b] = [first + corner, first + ((corner + 1) % count)];
      index.push(a, a + count, b + count, a, b + count, b);
      if (radius) index.push(a, b, first); // fills the disc, as the floor below a robot can be seen
    }
  }
  const geometry = new BufferGeometry().setIndex(index);
  geometry.setAttribute("position", new Float32BufferAttribute(positions, 3)).setAttribute("color", new Float32BufferAttribute(colours, 4));
  return new Mesh(geometry, material);
}
