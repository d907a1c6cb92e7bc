// Colors that change with the view, for a GLB of `tiface` in three.js (WebGLRenderer).
//
//     const gltf = await new GLTFLoader().loadAsync("head.glb");
//     const strength = await addLobes(gltf);     // null: the file holds none
//     scene.add(gltf.scene);
//
// The color of a point seen from the direction d is
//
//     base + sum over k of L_k Y_k(d),     L_k = (byte - 128) / 127 * scale[k]
//
// in sRGB-coded values, clamped to 0..1. L_k comes from one texture a function; Y_k are real spherical
// harmonics; d is the unit vector from the point to the viewer in the file's own axes, whatever the scene
// does to the head.

import { MeshBasicMaterial, NoColorSpace } from "three";

/**
 * Y_k of the unit vector d, in the order of the file's textures: the first four are degree 1, all nine
 * degree 2.
 */
export const BASIS = [
  "0.28209479",
  "-0.48860251 * d.y",
  "0.48860251 * d.z",
  "-0.48860251 * d.x",
  "1.0925484 * d.x * d.y",
  "-1.0925484 * d.y * d.z",
  "0.9461747 * d.z * d.z - 0.31539157",
  "-1.0925484 * d.x * d.z",
  "0.5462742 * (d.x * d.x - d.y * d.y)",
];

/**
 * Gives every mesh of a loaded glTF whose material names lobes, the head and its soft layers, a material
 * that shows them.
 *
 * Returns a uniform shared by all of them, `{ value: 1 }`: with 0 they show the base color alone. Null if
 * there are no lobes in the file.
 */
export async function addLobes(gltf) {
  const strength = { value: 1 };
  const meshes = [], textures = new Map();
  gltf.scene.traverse((object) => {
    if (object.isMesh && object.material.userData.tiface?.lobes?.length) meshes.push(object);
  });
  for (const mesh of meshes) {
    mesh.material = await lobeMaterial(gltf.parser, mesh.material, strength, textures);
  }
  return meshes.length ? strength : null;
}

/** A texture of a file as numbers, which are no colors; kept in `known` for the next that asks. */
async function numbersOf(parser, texture, known) {
  if (!known.has(texture)) {
    const numbers = (await parser.getDependency("texture", texture)).clone();
    numbers.colorSpace = NoColorSpace;
    numbers.needsUpdate = true;
    known.set(texture, numbers);
  }
  return known.get(texture);
}

async function lobeMaterial(parser, plain, strength, known) {
  const { lobes, view_dependent_color: model } = plain.userData.tiface;
  if (lobes.length > BASIS.length) throw new Error(`${lobes.length} lobes, but ${BASIS.length} functions are known`);
  const textures = [];
  for (const { texture } of lobes) textures.push(await numbersOf(parser, texture, known));
  // the pictures hold the light already: no lamp of the scene may touch them, and no tone mapping
  const { name, map, side, transparent, opacity, depthWrite, alphaTest, vertexColors } = plain;
  const material = new MeshBasicMaterial({
    name, map, side, transparent, opacity, depthWrite, alphaTest, vertexColors, toneMapped: false });
  material.userData = plain.userData;
  material.customProgramCacheKey = () => `tiface lobes ${lobes.length}`;
  material.onBeforeCompile = (shader) => {
    shader.uniforms.lobeStrength = strength;
    shader.uniforms.lobeScale = { value: model.scale };
    textures.forEach((value, k) => { shader.uniforms[`lobe${k}`] = { value }; });
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", "#include <common>\nvarying vec3 vToViewer;")
      .replace("#include <project_vertex>", `#include <project_vertex>
        vec3 toViewer = isOrthographic
          ? vec3(viewMatrix[0].z, viewMatrix[1].z, viewMatrix[2].z)
          : cameraPosition - (modelMatrix * vec4(transformed, 1.0)).xyz;
        vToViewer = toViewer * mat3(modelMatrix); // times the transpose: back into the file's axes`);
    const sum = lobes.map((_, k) =>
      `sum += (texture2D(lobe${k}, vMapUv).rgb * 255.0 - 128.0) / 127.0 * lobeScale[${k}] * (${BASIS[k]});`);
    shader.fragmentShader = shader.fragmentShader
      .replace("#include <common>", `#include <common>
        varying vec3 vToViewer;
        uniform float lobeStrength;
        uniform float lobeScale[${lobes.length}];
        ${lobes.map((_, k) => `uniform sampler2D lobe${k};`).join("\n")}`)
      .replace("#include <map_fragment>", `#include <map_fragment>
        vec3 d = normalize(vToViewer), sum = vec3(0.0);
        ${sum.join("\n        ")}
        vec3 coded = sRGBTransferOETF(vec4(diffuseColor.rgb, 1.0)).rgb + lobeStrength * sum;
        diffuseColor.rgb = sRGBTransferEOTF(vec4(clamp(coded, 0.0, 1.0), 1.0)).rgb;`);
  };
  return material;
}
