// The scene in 3-D: one mesh of all static shapes and one of each moving body; drawn only after a change.

import { GouraudMaterial } from "./lit.js";
import { beamLength } from "./live.js";
import { FloorShading } from "./shades.js";
import { mergeShapes } from "./solids.js";
import * as THREE from "./three.min.js";
import { OrbitControls } from "./three.min.js";

const GRID = 0.1; // distance of the grid lines [m]
const FAN_LENGTH = 0.042; // length of a field of view [m], as in the plan
const JUMP = 0.15; // a longer step is not interpolated [m]
const LINE_Z = 0.0006; // height of lines above the floor [m]
const SOFTWARE_RENDERERS = "SwiftShader|llvmpipe|Software";

export class ThreeD {
  followedIndex = null; // index of the robot that the camera follows
  #solidMaterial = new GouraudMaterial();
  #scene = new THREE.Scene();
  #staticGroup = new THREE.Group();
  #shading = new FloorShading();
  #bodies = [];
  #lamps = [];
  #robots = [];
  #previousPoses = [];
  #poses = [];
  #frame = 0;
  #pictureTime = 0;
  #pictureInterval = 40;
  #extent = new THREE.Box3();

  // `limit` is the number of line segments of a path. Throws an error where the browser has no WebGL.
  constructor(canvas, limit = 1500) {
    const probe = new OffscreenCanvas(1, 1).getContext("webgl2");
    if (!probe) throw new Error("no WebGL");
    const debugInfo = probe.getExtension("WEBGL_debug_renderer_info");
    const isSoftware = new RegExp(SOFTWARE_RENDERERS).test(debugInfo ? probe.getParameter(debugInfo.UNMASKED_RENDERER_WEBGL) : "");
    probe.getExtension("WEBGL_lose_context")?.loseContext();
    Object.assign(this, { canvas, limit });
    // Antialiasing takes too long without a GPU.
    const context = canvas.getContext("webgl2", { alpha: false, antialias: !isSoftware, stencil: false });
    this.renderer = new THREE.WebGLRenderer({ canvas, context });
    this.renderer.setPixelRatio(isSoftware ? 1 : Math.min(devicePixelRatio, 2));
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.01, 60);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { maxPolarAngle: Math.PI / 2, minDistance: 0.05, maxDistance: 30 });
    this.controls.addEventListener("change", () => this.requestFrame());
    this.#scene.add(this.#staticGroup, this.#shading.node);
    this.material = {
      solid: this.#solidMaterial,
      floor: Object.assign(new GouraudMaterial(this.#solidMaterial.uniforms), { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 }), // below its lines
      lines: new THREE.LineBasicMaterial(),
      trail: new THREE.LineBasicMaterial(),
      fans: new THREE.MeshBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false, side: THREE.DoubleSide }),
      beams: new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.12, depthWrite: false, side: THREE.DoubleSide }),
    };
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
    this.#resize();
  }

  // Replaces the scene; `robots` are those of a running twin with their paths, `powers` those of the lamps [W].
  load(scene, robots, powers) {
    const previousExtent = this.#extent.clone();
    this.#clear();
    this.#setColours();
    const floors = scene.shapes.filter(({ kind }) => kind === "plane");
    const lamps = scene.shapes.filter(({ name }) => /^lamp\d+$/.test(name));
    const solids = scene.shapes.filter((shape) => !floors.includes(shape) && !lamps.includes(shape));
    const mergeBody = (body) => mergeShapes(solids.filter((shape) => shape.body === body), scene.meshes);
    this.#staticGroup.add(new THREE.Mesh(mergeBody(null), this.material.solid));
    for (const floor of floors) this.#addFloor(floor, scene.meshes);
    this.#lamps = lamps.map((lamp) => {
      const bulb = new THREE.Mesh(mergeShapes([{ ...lamp, rgba: [1, 1, 1, 1] }], []), new THREE.MeshBasicMaterial());
      bulb.userData.colour = new THREE.Color().setRGB(...lamp.rgba.slice(0, 3), "srgb");
      bulb.material.color.copy(bulb.userData.colour);
      this.#staticGroup.add(bulb);
      return bulb;
    });
    this.#bodies = scene.bodies.map((_, index) => {
      const body = new THREE.Mesh(mergeBody(index), this.material.solid);
      this.#scene.add(body);
      return body;
    });
    this.#robots = robots.map((robot) => {
      const body = this.#bodies[scene.bodies.indexOf(`${robot.name}/base`)];
      const fan = createFans(robot, this.material.fans);
      const trail = new Trail(this.material.trail, this.limit);
      trail.show(robot.path);
      const beams = createBeams(robot, this.material.beams);
      body.add(fan, ...beams);
      this.#scene.add(trail.node);
      return { body, fan, beams, trail, robot };
    });
    if (this.followedIndex !== null && !this.#robots[this.followedIndex]) this.followedIndex = null;
    this.#poses = scene.poses;
    this.#interpolate(1);
    this.#shading.load(scene, lamps.map((lamp, index) => ({ ...lamp, colour: this.#lamps[index].userData.colour })), powers);
    this.#extent.setFromObject(this.#staticGroup);
    this.#solidMaterial.setLights(scene, this.#extent.getCenter(new THREE.Vector3()));
    if (!this.#extent.equals(previousExtent)) this.fit();
    this.canvas.dataset.shapes = scene.shapes.length;
    this.requestFrame();
  }

  // Shows the state of a running twin; bodies move to their new poses until the next state is expected, or at once.
  showPicture({ bodies, robots, lamps }, isAtOnce = false) {
    if (bodies.length !== this.#bodies.length) return; // its scene is not loaded yet
    const now = performance.now();
    this.#pictureInterval = Math.min(Math.max(now - this.#pictureTime, 20), 100);
    this.#pictureTime = isAtOnce ? 0 : now;
    this.#previousPoses = this.#bodies.map(({ position, quaternion }) => [position.clone(), quaternion.clone()]);
    this.#poses = bodies;
    robots.forEach(({ proximity, x_mm, y_mm, more }, index) => {
      const { fan, beams, trail, robot } = this.#robots[index] ?? {};
      if (!fan) return;
      const colours = fan.geometry.attributes.color;
      for (let vertex = 0; vertex < colours.count; vertex++) colours.setW(vertex, 0.05 + (0.6 * proximity[Math.floor(vertex / 9)]) / 1023);
      colours.needsUpdate = true;
      more?.ultrasonic?.forEach((reading, sensor) => beams[sensor].scale.setScalar(beamLength(robot, reading) / 1e3 || 1e-6));
      trail.add(x_mm / 1e3, y_mm / 1e3);
    });
    this.#shading.setPoses(bodies);
    this.#shading.setPowers(lamps.map(({ power_w }) => power_w));
    lamps.forEach(({ power_w }, index) => {
      const bulb = this.#lamps[index];
      if (bulb) power_w ? bulb.material.color.copy(bulb.userData.colour) : bulb.material.color.setScalar(0.25);
    });
    this.requestFrame();
  }

  // Replaces the paths.
  showPaths(paths) {
    this.#robots.forEach(({ trail }, index) => trail.show(paths[index]));
    this.requestFrame();
  }

  // Requests the next frame; several requests draw it once.
  requestFrame() {
    this.#frame ||= requestAnimationFrame((now) => {
      this.#frame = 0;
      if (!this.canvas.clientWidth) return;
      // On a slow machine, the time of the frame may be before that of the picture.
      const fraction = Math.min((performance.now() - this.#pictureTime) / this.#pictureInterval, 1);
      this.#interpolate(fraction);
      this.renderer.render(this.#scene, this.camera);
      requestAnimationFrame((nextTime) => this.#shading.measureFrame(nextTime - now));
      if (fraction < 1) this.requestFrame();
    });
  }

  // Shows the whole arena.
  fit() {
    const [centre, size] = [new THREE.Vector3(), new THREE.Vector3()];
    this.#extent.getCenter(centre);
    this.#extent.getSize(size);
    const height = Math.max(size.y, size.x / Math.max(this.camera.aspect, 0.1)) || 1;
    this.controls.target.copy(centre).setZ(0);
    this.camera.position.set(centre.x, centre.y - 0.92 * height, 1.25 * height);
    this.controls.update();
    this.requestFrame();
  }

  // Follows a robot; with null, none.
  follow(index) {
    this.followedIndex = this.#robots[index] ? index : null;
    if (this.followedIndex !== null) this.#moveTarget(this.#robots[index].body.position);
    this.requestFrame();
  }

  handleKey({ key, shiftKey }) {
    const { controls } = this;
    const direction = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[key];
    if (direction && shiftKey) controls.pan(30 * direction[0], 30 * direction[1]);
    else if (direction?.[0]) controls.rotateLeft(0.1 * direction[0]);
    else if (direction) controls.rotateUp(0.1 * direction[1]);
    else if (key === "+" || key === "=") controls.dollyIn(0.87);
    else if (key === "-") controls.dollyOut(0.87);
    else if (key === "0") this.fit();
    else return false;
    return true;
  }

  // Places the bodies between their previous poses and the last ones.
  #interpolate(fraction) {
    const rotation = new THREE.Quaternion();
    this.#bodies.forEach(({ position, quaternion }, index) => {
      const [x, y, z, w, i, j, k] = this.#poses[index];
      const previous = fraction < 1 && this.#previousPoses[index];
      rotation.set(i, j, k, w);
      position.set(x, y, z);
      quaternion.copy(rotation);
      if (!previous || previous[0].distanceTo(position) > JUMP) return;
      position.lerpVectors(previous[0], position, fraction);
      quaternion.slerpQuaternions(previous[1], rotation, fraction);
    });
    if (this.followedIndex !== null) this.#moveTarget(this.#robots[this.followedIndex].body.position);
  }

  // Moves the target of the camera, and the camera with it.
  #moveTarget({ x, y }) {
    const { target } = this.controls;
    const [dx, dy] = [x - target.x, y - target.y];
    if (!dx && !dy) return;
    target.set(x, y, target.z);
    this.camera.position.x += dx;
    this.camera.position.y += dy;
    this.camera.lookAt(target);
  }

  #addFloor(floor, meshes) {
    const [[x, y], [width, depth]] = [floor.pose, floor.size];
    this.#staticGroup.add(new THREE.Mesh(mergeShapes([{ ...floor, rgba: [1, 1, 1, 1] }], meshes), this.material.floor));
    const corners = [];
    const lines = (low, high) => Array.from({ length: Math.floor(high / GRID) - Math.ceil(low / GRID) + 1 }, (_, index) => (Math.ceil(low / GRID) + index) * GRID);
    for (const coordinate of lines(x - width, x + width)) corners.push(coordinate, y - depth, LINE_Z / 2, coordinate, y + depth, LINE_Z / 2);
    for (const coordinate of lines(y - depth, y + depth)) corners.push(x - width, coordinate, LINE_Z / 2, x + width, coordinate, LINE_Z / 2);
    const grid = new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(corners, 3));
    this.#staticGroup.add(new THREE.LineSegments(grid, this.material.lines));
  }

  #clear() {
    const nodes = [...this.#staticGroup.children, ...this.#bodies, ...this.#robots.flatMap(({ fan, beams, trail }) => [fan, ...beams, trail.node])];
    for (const node of nodes) {
      node.geometry?.dispose();
      node.dispose?.();
      node.removeFromParent();
    }
    for (const { material } of this.#lamps) material.dispose();
  }

  // Sets the colours of the page, which differ in dark mode.
  #setColours() {
    this.#scene.background = readColour("--around");
    this.material.floor.uniforms.tint.value.copy(readColour("--floor"));
    for (const [name, colour] of [["lines", "lines"], ["trail", "trail"], ["beams", "ray"]]) this.material[name].color.copy(readColour(`--${colour}`));
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.requestFrame();
  }
}

const readColour = (name) => new THREE.Color(getComputedStyle(document.documentElement).getPropertyValue(name).trim());

// Path of a robot so far: a ring buffer of separate line segments.
class Trail {
  #count = 0;
  #last = null;

  constructor(material, limit) {
    const geometry = new THREE.BufferGeometry();
    this.limit = limit;
    this.positions = new THREE.BufferAttribute(new Float32Array(6 * limit), 3).setUsage(THREE.DynamicDrawUsage);
    geometry.setAttribute("position", this.positions).setDrawRange(0, 0);
    this.node = Object.assign(new THREE.LineSegments(geometry, material), { frustumCulled: false });
  }

  // Shows a path of points in mm instead.
  show(points) {
    this.#count = 0;
    this.#last = null;
    this.node.geometry.setDrawRange(0, 0);
    for (const [x, y] of points) this.add(x / 1e3, y / 1e3);
  }

  add(x, y) {
    const distance = this.#last ? Math.hypot(x - this.#last[0], y - this.#last[1]) : 0;
    if (this.#last && distance < 0.003) return;
    if (this.#last && distance < JUMP) {
      const slot = this.#count++ % this.limit;
      this.positions.array.set([...this.#last, LINE_Z, x, y, LINE_Z], 6 * slot);
      this.positions.addUpdateRange(6 * slot, 6);
      this.positions.needsUpdate = true;
      this.node.geometry.setDrawRange(0, 2 * Math.min(this.#count, this.limit));
    }
    this.#last = [x, y];
  }
}

// Creates a beam for each ultrasonic sensor: a sector of 30 degrees and 1 m (a flat cone), scaled to the distance.
function createBeams({ sonar }, material) {
  return sonar.map(([x, y, z, heading]) => {
    const cone = new THREE.CylinderGeometry(0, 1, 0, 6, 1, true, ((heading + 75) * Math.PI) / 180, Math.PI / 6).rotateX(Math.PI / 2);
    const beam = new THREE.Mesh(cone, material);
    beam.position.set(x / 1e3, y / 1e3, z / 1e3);
    beam.scale.setScalar(1e-6); // until its first reading
    return beam;
  });
}

// Creates the fields of view of a robot's sensors, which are drawn stronger at higher counts.
function createFans({ sensors, sensor_height_mm: height }, material) {
  const corners = sensors.flatMap(([x, y, heading]) => {
    const angles = [-20, -7, 7, 20].map((offset) => ((heading + offset) * Math.PI) / 180);
    const rim = angles.map((angle) => [x / 1e3 + FAN_LENGTH * Math.cos(angle), y / 1e3 + FAN_LENGTH * Math.sin(angle), height / 1e3]);
    return [0, 1, 2].flatMap((triangle) => [x / 1e3, y / 1e3, height / 1e3, ...rim[triangle], ...rim[triangle + 1]]);
  });
  const geometry = new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(corners, 3));
  const { r, g, b } = readColour("--ray");
  const colours = new THREE.Float32BufferAttribute(corners.length / 3 * 4, 4).setUsage(THREE.DynamicDrawUsage);
  for (let vertex = 0; vertex < colours.count; vertex++) colours.setXYZW(vertex, r, g, b, 0.05);
  return new THREE.Mesh(geometry.setAttribute("color", colours), material);
}
