// Shapes of a compiled scene as geometries of three.js; shapes are merged into one geometry, as this draws faster.

import { BoxGeometry, BufferGeometry, CapsuleGeometry, Color, CylinderGeometry, Float32BufferAttribute, Matrix4, PlaneGeometry, Quaternion, SphereGeometry, Vector3 } from "./three.min.js";

const INFINITE_HALF = 10; // drawn half length of an infinite plane [m]

const countSegments = (radius) => (radius < 0.004 ? 10 : radius < 0.02 ? 24 : 40);

// MuJoCo's sizes are half lengths, and its cylinders have their axis along z.
const CREATE = {
  box: ([x, y, z]) => new BoxGeometry(2 * x, 2 * y, 2 * z),
  cylinder: ([r, half]) => new CylinderGeometry(r, r, 2 * half, countSegments(r)).rotateX(Math.PI / 2),
  capsule: ([r, half]) => new CapsuleGeometry(r, 2 * half, 6, countSegments(r)).rotateX(Math.PI / 2),
  sphere: ([r]) => new SphereGeometry(r, countSegments(r), countSegments(r) / 2),
  ellipsoid: ([x, y, z]) => new SphereGeometry(1, 24, 12).scale(x, y, z),
  plane: ([x, y]) => new PlaneGeometry(2 * (x || INFINITE_HALF), 2 * (y || INFINITE_HALF)),
};

export const poseMatrix = ([x, y, z, w, i, j, k]) => new Matrix4().compose(new Vector3(x, y, z), new Quaternion(i, j, k, w), new Vector3(1, 1, 1));

// Returns one geometry of many shapes, each in its pose and colour.
export function mergeShapes(shapes, meshes) {
  const arrays = { position: [], normal: [], color: [], index: [] };
  for (const { kind, size, pose, rgba, mesh } of shapes) {
    const geometry = (kind === "mesh" ? createMeshGeometry(meshes[mesh]) : CREATE[kind](size)).applyMatrix4(poseMatrix(pose));
    const first = arrays.position.length / 3;
    const colour = new Color().setRGB(...rgba.slice(0, 3), "srgb");
    for (const index of geometry.index.array) arrays.index.push(first + index);
    for (const name of ["position", "normal"]) for (const value of geometry.attributes[name].array) arrays[name].push(value);
    for (let corner = 0; corner < geometry.attributes.position.count; corner++) arrays.color.push(colour.r, colour.g, colour.b);
    geometry.dispose();
  }
  const merged = new BufferGeometry().setIndex(arrays.index);
  for (const name of ["position", "normal", "color"]) merged.setAttribute(name, new Float32BufferAttribute(arrays[name], 3));
  return merged;
}

function createMeshGeometry({ points, faces }) {
  const corners = new Float32BufferAttribute(faces.flat().flatMap((index) => points[index]), 3);
  const geometry = new BufferGeometry().setAttribute("position", corners);
  geometry.computeVertexNormals(); // no triangles share vertices, so the faces are flat
  return geometry.setIndex([...Array(corners.count).keys()]);
}
