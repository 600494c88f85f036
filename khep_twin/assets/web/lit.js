// A material with Gouraud shading: the light is computed at the vertices only, as a GPU may be missing.

import { Color, ShaderMaterial, Vector3 } from "./three.min.js";

const LIGHTS = 4;

const VERTEX_SHADER = `
attribute vec3 color;
uniform vec3 tint, ambient, head, directions[${LIGHTS}], diffuse[${LIGHTS}];
varying vec3 shade;
void main() {
  vec4 point = modelViewMatrix * vec4(position, 1.0);
  vec3 outward = normalize(normalMatrix * normal);
  vec3 light = ambient + head * max(dot(outward, normalize(-point.xyz)), 0.0);
  for (int i = 0; i < ${LIGHTS}; i++) light += diffuse[i] * max(dot(outward, mat3(viewMatrix) * directions[i]), 0.0);
  shade = pow(tint * color * light, vec3(0.4545));
  gl_Position = projectionMatrix * point;
}`;

const FRAGMENT_SHADER = `
varying vec3 shade;
void main() { gl_FragColor = vec4(shade, 1.0); }`;

export class GouraudMaterial extends ShaderMaterial {
  // Shares the lights of another material's uniforms, if given.
  constructor(sharedLights = null) {
    const directions = Array.from({ length: LIGHTS }, () => new Vector3());
    const lights = sharedLights ?? { ambient: { value: new Color(1, 1, 1) }, head: { value: new Color(0, 0, 0) }, directions: { value: directions }, diffuse: { value: blackLights() } };
    super({ uniforms: { ...lights, tint: { value: new Color(1, 1, 1) } }, vertexShader: VERTEX_SHADER, fragmentShader: FRAGMENT_SHADER });
  }

  // Sets the lights of a scene; those with a position shine from there to the centre of the floor.
  setLights({ lights, headlight }, centre) {
    const { ambient, head, directions, diffuse } = this.uniforms;
    ambient.value.setRGB(...headlight.ambient);
    head.value.setRGB(...headlight.diffuse);
    diffuse.value = blackLights();
    lights.slice(0, LIGHTS).forEach((light, index) => {
      if (light.directional) directions.value[index].set(...light.direction).negate();
      else directions.value[index].set(...light.at).sub(centre).normalize();
      diffuse.value[index].setRGB(...light.diffuse);
      ambient.value.add(new Color(...light.ambient));
    });
  }
}

const blackLights = () => Array.from({ length: LIGHTS }, () => new Color(0, 0, 0));
