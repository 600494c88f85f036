// A material that is lit at the corners only: a pixel costs nothing but its colour, also where a processor draws it.

import { Color, ShaderMaterial, Vector3 } from "./three.min.js";

const LIGHTS = 4;

const CORNER = `
attribute vec3 color;
uniform vec3 tint, ambient, head, from[${LIGHTS}], diffuse[${LIGHTS}];
varying vec3 seen;
void main() {
  vec4 at = modelViewMatrix * vec4(position, 1.0);
  vec3 out_ = normalize(normalMatrix * normal);
  vec3 light = ambient + head * max(dot(out_, normalize(-at.xyz)), 0.0);
  for (int i = 0; i < ${LIGHTS}; i++) light += diffuse[i] * max(dot(out_, mat3(viewMatrix) * from[i]), 0.0);
  seen = pow(tint * color * light, vec3(0.4545));
  gl_Position = projectionMatrix * at;
}`;

const PIXEL = `
varying vec3 seen;
void main() { gl_FragColor = vec4(seen, 1.0); }`;

const dark = () => Array.from({ length: LIGHTS }, () => new Color(0, 0, 0));

export class Lit extends ShaderMaterial {
  constructor(lights = null) {
    const from = Array.from({ length: LIGHTS }, () => new Vector3());
    const own = { ambient: { value: new Color(1, 1, 1) }, head: { value: new Color(0, 0, 0) }, from: { value: from }, diffuse: { value: dark() } };
    super({ uniforms: { ...(lights ?? own), tint: { value: new Color(1, 1, 1) } }, vertexShader: CORNER, fragmentShader: PIXEL });
  }

  // Takes the lights of a scene, of which those at a place shine from there to the middle of the floor.
  light({ lights, headlight }, middle) {
    const { ambient, head, from, diffuse } = this.uniforms;
    ambient.value.setRGB(...headlight.ambient);
    head.value.setRGB(...headlight.diffuse);
    diffuse.value = dark();
    lights.slice(0, LIGHTS).forEach((light, index) => {
      if (light.directional) from.value[index].set(...light.direction).negate();
      else from.value[index].set(...light.at).sub(middle).normalize();
      diffuse.value[index].setRGB(...light.diffuse);
      ambient.value.add(new Color(...light.ambient));
    });
  }
}
