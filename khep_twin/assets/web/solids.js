// Shapes of a compiled scene as geometries of three.js; many shapes become one, which is drawn at once.

import { BoxGeometry, BufferGeometry, CapsuleGeometry, Color, CylinderGeometry, Float32BufferAttribute, Matrix4, PlaneGeometry, Quaternion, SphereGeometry, Vector3 } from "./three.min.js";

const ENDLESS = 10; // half the length of a plane without an end [m]

const round = (radius) => (radius < 0.004 ? 10 : radius < 0.02 ? 24 : 40);

// MuJoCo's sizes are halves, and its cylinders stand along z.
const MAKE = {
  box: ([x, y, z]) => new BoxGeometry(2 * x, 2 * y, 2 * z),
  cylinder: ([r, half]) => new CylinderGeometry(r, r, 2 * half, round(r)).rotateX(Math.PI / 2),
  capsule: ([r, half]) => new CapsuleGeometry(r, 2 * half, 6, round(r)).rotateX(Math.PI / 2),
  sphere: ([r]) => new SphereGeometry(r, round(r), round(r) / 2),
  ellipsoid: ([x, y, z]) => new SphereGeometry(1, 24, 12).scale(x, y, z),
  plane: ([x, y]) => new PlaneGeometry(2 * (x || ENDLESS), 2 * (y || ENDLESS)),
};

function ofMesh({ points, faces }) {
  const corners = new Float32BufferAttribute(faces.flat().flatMap((index) => points[index]), 3);
  const geometry = new BufferGeometry().setAttribute("position", corners);
  geometry.computeVertexNormals(); // each triangle has corners of its own: its faces are flat
  return geometry.setIndex([...Array(corners.count).keys()]);
}

export const frame = ([x, y, z, w, i, j, k]) => new Matrix4().compose(new Vector3(x, y, z), new Quaternion(i, j, k, w), new Vector3(1, 1, 1));

// One geometry of many shapes, each in its pose and colour.
export function merged(shapes, meshes) {
  const found = { position: [], normal: [], color: [], index: [] };
  for (const { kind, size, pose, rgba, mesh } of shapes) {
    const part = (kind === "mesh" ? ofMesh(meshes[mesh]) : MAKE[kind](size)).applyMatrix4(frame(pose));
    const first = found.position.length / 3;
    const colour = new Color().setRGB(...rgba.slice(0, 3), "srgb");
    for (const index of part.index.array) found.index.push(first + index);
    for (const name of ["position", "normal"]) for (const value of part.attributes[name].array) found[name].push(value);
    for (let corner = 0; corner < part.attributes.position.count; corner++) found.color.push(colour.r, colour.g, colour.b);
    part.dispose();
  }
  const whole = new BufferGeometry().setIndex(found.index);
  for (const name of ["position", "normal", "color"]) whole.setAttribute(name, new Float32BufferAttribute(found[name], 3));
  return whole;
}
