// The scene in 3-D: what stands still is one mesh, and each body that moves another; drawn only when it has changed.

import { Lit } from "./lit.js";
import { Shades } from "./shades.js";
import { merged } from "./solids.js";
import * as THREE from "./three.min.js";
import { OrbitControls } from "./three.min.js";

const TRAIL = 1500; // parts of a path that are kept
const LINE = 0.1; // distance of the floor's lines [m]
const REACH = 0.042; // length of a field of view [m], as in the plan
const JUMP = 0.15;
const ABOVE = 0.0006; // lines lie above the floor by this [m]
const SOFT = "SwiftShader|llvmpipe|Software";

const colour = (name) => new THREE.Color(getComputedStyle(document.documentElement).getPropertyValue(name).trim());

// Path of a robot so far: a ring of separate parts, so that its size is fixed.
class Trail {
  #parts = 0;
  #last = null;

  constructor(material) {
    const geometry = new THREE.BufferGeometry();
    this.places = new THREE.BufferAttribute(new Float32Array(6 * TRAIL), 3).setUsage(THREE.DynamicDrawUsage);
    geometry.setAttribute("position", this.places).setDrawRange(0, 0);
    this.node = Object.assign(new THREE.LineSegments(geometry, material), { frustumCulled: false });
  }

  add(x, y) {
    const way = this.#last ? Math.hypot(x - this.#last[0], y - this.#last[1]) : 0;
    if (this.#last && way < 0.003) return;
    if (this.#last && way < JUMP) {
      const at = this.#parts++ % TRAIL;
      this.places.array.set([...this.#last, ABOVE, x, y, ABOVE], 6 * at);
      this.places.addUpdateRange(6 * at, 6);
      this.places.needsUpdate = true;
      this.node.geometry.setDrawRange(0, 2 * Math.min(this.#parts, TRAIL));
    }
    this.#last = [x, y];
  }
}

// Fields of view of a robot's sensors, stronger at higher counts.
function fans({ sensors, sensor_height_mm: height }, material) {
  const corners = sensors.flatMap(([x, y, heading]) => {
    const rim = [-20, -7, 7, 20].map((aside) => ((heading + aside) * Math.PI) / 180);
    const at = rim.map((angle) => [x / 1e3 + REACH * Math.cos(angle), y / 1e3 + REACH * Math.sin(angle), height / 1e3]);
    return [0, 1, 2].flatMap((part) => [x / 1e3, y / 1e3, height / 1e3, ...at[part], ...at[part + 1]]);
  });
  const geometry = new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(corners, 3));
  const { r, g, b } = colour("--ray");
  const colours = new THREE.Float32BufferAttribute(corners.length / 3 * 4, 4).setUsage(THREE.DynamicDrawUsage);
  for (let at = 0; at < colours.count; at++) colours.setXYZW(at, r, g, b, 0.05);
  return new THREE.Mesh(geometry.setAttribute("color", colours), material);
}

export class ThreeD {
  followed = null; // index of the robot that the camera follows
  #solid = new Lit();
  #scene = new THREE.Scene();
  #still = new THREE.Group();
  #shades = new Shades();
  #bodies = [];
  #lamps = [];
  #robots = [];
  #from = [];
  #to = [];
  #frame = 0;
  #arrived = 0;
  #gap = 40;
  #extent = new THREE.Box3();

  // Throws an error where the browser has no WebGL.
  constructor(canvas) {
    const probe = new OffscreenCanvas(1, 1).getContext("webgl2");
    if (!probe) throw new Error("no WebGL");
    const named = probe.getExtension("WEBGL_debug_renderer_info");
    const soft = new RegExp(SOFT).test(named ? probe.getParameter(named.UNMASKED_RENDERER_WEBGL) : "");
    probe.getExtension("WEBGL_lose_context")?.loseContext();
    this.canvas = canvas;
    // Smooth edges take too long where a processor draws.
    const context = canvas.getContext("webgl2", { alpha: false, antialias: !soft, stencil: false });
    this.renderer = new THREE.WebGLRenderer({ canvas, context });
    this.renderer.setPixelRatio(soft ? 1 : Math.min(devicePixelRatio, 2));
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.01, 60);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { maxPolarAngle: Math.PI / 2, minDistance: 0.05, maxDistance: 30 });
    this.controls.addEventListener("change", () => this.draw());
    this.#scene.add(this.#still, this.#shades.node);
    this.material = {
      solid: this.#solid,
      floor: new Lit(this.#solid.uniforms),
      lines: new THREE.LineBasicMaterial(),
      trail: new THREE.LineBasicMaterial(),
      fans: new THREE.MeshBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false, side: THREE.DoubleSide }),
    };
    new ResizeObserver(() => this.#size()).observe(canvas.parentElement);
    this.#size();
  }

  // Takes a scene in place of the one before; robots are those of a running twin, powers those of the lamps [W].
  load(scene, robots, powers) {
    const before = this.#extent.clone();
    this.#clear();
    this.#paint();
    const floors = scene.shapes.filter(({ kind }) => kind === "plane");
    const lamps = scene.shapes.filter(({ name }) => /^lamp\d+$/.test(name));
    const rest = scene.shapes.filter((shape) => !floors.includes(shape) && !lamps.includes(shape));
    const of = (body) => merged(rest.filter((shape) => shape.body === body), scene.meshes);
    const solid = new THREE.Mesh(of(null), this.material.solid);
    this.#still.add(solid);
    for (const floor of floors) this.#floor(floor, scene.meshes);
    this.#lamps = lamps.map((lamp) => {
      const bulb = new THREE.Mesh(merged([{ ...lamp, rgba: [1, 1, 1, 1] }], []), new THREE.MeshBasicMaterial());
      bulb.userData.lit = new THREE.Color().setRGB(...lamp.rgba.slice(0, 3), "srgb");
      bulb.material.color.copy(bulb.userData.lit);
      this.#still.add(bulb);
      return bulb;
    });
    this.#bodies = scene.bodies.map((_, index) => {
      const body = new THREE.Mesh(of(index), this.material.solid);
      this.#scene.add(body);
      return body;
    });
    this.#robots = robots.map((robot) => {
      const body = this.#bodies[scene.bodies.indexOf(`${robot.name}/base`)];
      const fan = fans(robot, this.material.fans);
      const trail = new Trail(this.material.trail);
      for (const [x, y] of robot.places) trail.add(x / 1e3, y / 1e3);
      body.add(fan);
      this.#scene.add(trail.node);
      return { body, fan, trail };
    });
    if (this.followed !== null && !this.#robots[this.followed]) this.followed = null;
    this.#to = scene.poses;
    this.#put(1);
    this.#shades.load(scene, lamps.map((lamp, index) => ({ ...lamp, lit: this.#lamps[index].userData.lit })), powers);
    this.#extent.setFromObject(this.#still);
    this.#solid.light(scene, this.#extent.getCenter(new THREE.Vector3()));
    if (!this.#extent.equals(before)) this.fit();
    this.canvas.dataset.shapes = scene.shapes.length;
    this.draw();
  }

  // Takes the state of a running twin; what has moved goes there until the next one comes.
  picture({ bodies, robots, lamps }) {
    if (bodies.length !== this.#bodies.length) return; // of a twin that has just been started
    const now = performance.now();
    this.#gap = Math.min(Math.max(now - this.#arrived, 20), 100);
    this.#arrived = now;
    this.#from = this.#bodies.map(({ position, quaternion }) => [position.clone(), quaternion.clone()]);
    this.#to = bodies;
    robots.forEach(({ proximity, x_mm, y_mm }, index) => {
      const { fan, trail } = this.#robots[index] ?? {};
      if (!fan) return;
      const colours = fan.geometry.attributes.color;
      for (let at = 0; at < colours.count; at++) colours.setW(at, 0.05 + (0.6 * proximity[Math.floor(at / 9)]) / 1023);
      colours.needsUpdate = true;
      trail.add(x_mm / 1e3, y_mm / 1e3);
    });
    this.#shades.move(bodies);
    this.#shades.shine(lamps.map(({ power_w }) => power_w));
    lamps.forEach(({ power_w }, index) => {
      const bulb = this.#lamps[index];
      if (bulb) power_w ? bulb.material.color.copy(bulb.userData.lit) : bulb.material.color.setScalar(0.25);
    });
    this.draw();
  }

  // Draws the next frame, once however often it is asked for.
  draw() {
    this.#frame ||= requestAnimationFrame((now) => {
      this.#frame = 0;
      if (!this.canvas.clientWidth) return;
      const part = Math.min((now - this.#arrived) / this.#gap, 1);
      this.#put(part);
      this.renderer.render(this.#scene, this.camera);
      requestAnimationFrame((next) => this.#shades.measure(next - now));
      if (part < 1) this.draw();
    });
  }

  // Shows the whole arena.
  fit() {
    const [middle, size] = [new THREE.Vector3(), new THREE.Vector3()];
    this.#extent.getCenter(middle);
    this.#extent.getSize(size);
    const across = Math.max(size.y, size.x / Math.max(this.camera.aspect, 0.1)) || 1;
    this.controls.target.copy(middle).setZ(0);
    this.camera.position.set(middle.x, middle.y - 0.92 * across, 1.25 * across);
    this.controls.update();
    this.draw();
  }

  // Follows a robot from now on, or with null none.
  follow(index) {
    this.followed = this.#robots[index] ? index : null;
    if (this.followed !== null) this.#aim(this.#robots[index].body.position);
    this.draw();
  }

  key({ key, shiftKey }) {
    const { controls } = this;
    const way = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[key];
    if (way && shiftKey) controls.pan(30 * way[0], 30 * way[1]);
    else if (way?.[0]) controls.rotateLeft(0.1 * way[0]);
    else if (way) controls.rotateUp(0.1 * way[1]);
    else if (key === "+" || key === "=") controls.dollyIn(0.87);
    else if (key === "-") controls.dollyOut(0.87);
    else if (key === "0") this.fit();
    else return false;
    return true;
  }

  #put(part) {
    const turned = new THREE.Quaternion();
    this.#bodies.forEach(({ position, quaternion }, index) => {
      const [x, y, z, w, i, j, k] = this.#to[index];
      const from = part < 1 && this.#from[index];
      turned.set(i, j, k, w);
      position.set(x, y, z);
      quaternion.copy(turned);
      if (!from || from[0].distanceTo(position) > JUMP) return;
      position.lerpVectors(from[0], position, part);
      quaternion.slerpQuaternions(from[1], turned, part);
    });
    if (this.followed !== null) this.#aim(this.#robots[this.followed].body.position);
  }

  // Moves the camera with what it looks at.
  #aim({ x, y }) {
    const { target } = this.controls;
    const [dx, dy] = [x - target.x, y - target.y];
    if (!dx && !dy) return;
    target.set(x, y, target.z);
    this.camera.position.x += dx;
    this.camera.position.y += dy;
    this.camera.lookAt(target);
  }

  #floor(floor, meshes) {
    const [[x, y], [width, depth]] = [floor.pose, floor.size];
    this.#still.add(new THREE.Mesh(merged([{ ...floor, rgba: [1, 1, 1, 1] }], meshes), this.material.floor));
    const corners = [];
    const lines = (low, high) => Array.from({ length: Math.floor(high / LINE) - Math.ceil(low / LINE) + 1 }, (_, turn) => (Math.ceil(low / LINE) + turn) * LINE);
    for (const at of lines(x - width, x + width)) corners.push(at, y - depth, ABOVE / 2, at, y + depth, ABOVE / 2);
    for (const at of lines(y - depth, y + depth)) corners.push(x - width, at, ABOVE / 2, x + width, at, ABOVE / 2);
    const grid = new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(corners, 3));
    this.#still.add(new THREE.LineSegments(grid, this.material.lines));
  }

  #clear() {
    const nodes = [...this.#still.children, ...this.#bodies, ...this.#robots.flatMap(({ fan, trail }) => [fan, trail.node])];
    for (const node of nodes) {
      node.geometry?.dispose();
      node.dispose?.();
      node.removeFromParent();
    }
    for (const { material } of this.#lamps) material.dispose();
  }

  // Colours of the page, which are others in the dark.
  #paint() {
    this.#scene.background = colour("--around");
    this.material.floor.uniforms.tint.value.copy(colour("--floor"));
    for (const name of ["lines", "trail"]) this.material[name].color.copy(colour(`--${name}`));
  }

  #size() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }
}
