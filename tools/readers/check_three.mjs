// Opens textured exports in three.js, without a browser: its loaders for GLB, OBJ, MTL and PLY.
//
//     cargo run --example textured_sphere -- DIR
//     npm ci --prefix tools/readers
//     node tools/readers/check_three.mjs DIR/globe.glb
//
// The .obj, .mtl, .ply and .png are looked for beside the .glb; those that are not there are passed
// over aloud. In each: the same box to 1e-6 of its size (PLY: of the dataset's world, which may be
// turned, so its sorted sides), closed after welding equal positions, positive volume, texture
// coordinates that agree corner by corner. The GLB's picture is the .png to the pixel, and its
// material is unlit. Soft layers are drawn from both sides, blended. Exits 1 after printing every disagreement.

import { readFile } from "node:fs/promises";
import { existsSync } from "node:fs";
import { PNG } from "pngjs";

// what GLTFLoader takes from a browser: a way to decode pictures
globalThis.self = globalThis;
globalThis.createImageBitmap = async (blob) => {
  const bytes = Buffer.from(await blob.arrayBuffer());
  const { width, height, data } = PNG.sync.read(bytes);
  return { width, height, data, close() {} };
};
const { Vector3, Box3 } = await import("three");
const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
const { OBJLoader } = await import("three/addons/loaders/OBJLoader.js");
const { MTLLoader } = await import("three/addons/loaders/MTLLoader.js");
const { PLYLoader } = await import("three/addons/loaders/PLYLoader.js");

let wrong = 0;
const check = (name, right, what) => {
  if (!right) {
    console.log(`WRONG ${name}: ${what}`);
    wrong += 1;
  }
};

/** Corner by corner: places, texture coordinates with v up, and what the surface is like. */
function facts(geometry, matrix, flipped) {
  const at = geometry.getAttribute("position");
  const uv = geometry.getAttribute("uv");
  const count = geometry.index ? geometry.index.count : at.count;
  const corners = [];
  const uvs = [];
  const numbers = new Map();
  const weld = [];
  for (let i = 0; i < count; i++) {
    const v = geometry.index ? geometry.index.getX(i) : i;
    const p = new Vector3().fromBufferAttribute(at, v);
    const key = `${p.x} ${p.y} ${p.z}`;
    if (!numbers.has(key)) numbers.set(key, numbers.size);
    weld.push(numbers.get(key));
    corners.push(matrix ? p.applyMatrix4(matrix) : p);
    if (uv) uvs.push([uv.getX(v), flipped ? 1 - uv.getY(v) : uv.getY(v)]);
  }
  const edges = new Map();
  let volume = 0;
  for (let i = 0; i < count; i += 3) {
    const [a, b, c] = [weld[i], weld[i + 1], weld[i + 2]];
    for (const edge of [`${a} ${b}`, `${b} ${c}`, `${c} ${a}`]) edges.set(edge, (edges.get(edge) ?? 0) + 1);
    volume += corners[i].dot(corners[i + 1].clone().cross(corners[i + 2])) / 6;
  }
  const closed = [...edges].every(([edge, n]) => n === 1 && edges.get(edge.split(" ").reverse().join(" ")) === 1);
  return { box: new Box3().setFromPoints(corners), closed, volume, uvs, triangles: count / 3 };
}

/** The mesh, and the soft layers around it in the order in which they are drawn. */
const meshesOf = (object) => {
  const [meshes, layers] = [[], []];
  object.traverse((o) => o.isMesh && (o.material.transparent ? layers : meshes).push(o));
  // objects at the same distance are drawn in the order of their numbers
  return { meshes, layers: layers.sort((a, b) => a.id - b.id) };
};

const only = (object) => {
  const { meshes } = meshesOf(object);
  if (meshes.length !== 1) throw new Error(`${meshes.length} meshes, expected 1`);
  return meshes[0];
};

for (const glb of process.argv.slice(2)) {
  const stem = glb.replace(/\.glb$/, "");
  const short = stem.split("/").pop();
  const bytes = await readFile(glb);
  const loader = new GLTFLoader();
  const { scene } = await loader.parseAsync(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length), "");
  scene.updateMatrixWorld(true);
  const mesh = only(scene);
  const found = { glb: facts(mesh.geometry, mesh.matrixWorld, true) };
  const { material } = mesh;
  check(`${short}.glb`, material.type === "MeshBasicMaterial", `material ${material.type}, expected an unlit one`);
  check(`${short}.glb`, material.map?.image, "no picture");
  check(`${short}.glb`, material.map?.wrapS === 1001 && material.map?.minFilter === 1008, "sampler not clamped and mip-mapped");
  const { layers } = meshesOf(scene);
  if (layers.length) console.log(`${short}.glb has ${layers.length} soft layers`);
  layers.forEach((layer, k) => {
    const { material: soft } = layer;
    check(`${short}.glb`, !soft.depthWrite && soft.side === 2 && soft.vertexColors && soft.map === material.map,
      `layer ${k} is not blended over what it is around, with its picture and both sides`);
    check(`${short}.glb`, layer.geometry.getAttribute("color")?.itemSize === 4, `layer ${k} has no opacity`);
  });
  const picture = `${stem}.png`;
  if (existsSync(picture)) {
    const expected = PNG.sync.read(await readFile(picture));
    const image = material.map?.image;
    const same = image && image.width === expected.width && Buffer.compare(image.data, expected.data) === 0;
    check(`${short}.glb`, same, `picture differs from ${short}.png`);
  } else {
    console.log(`passed over: there is no ${short}.png`);
  }
  if (existsSync(`${stem}.obj`)) {
    const text = await readFile(`${stem}.obj`, "utf8");
    found.obj = facts(only(new OBJLoader().parse(text)).geometry, null, false);
    const library = /^mtllib (.*)$/m.exec(text)?.[1];
    const mtl = new MTLLoader().parse(await readFile(`${stem}.obj`.replace(/[^/]*$/, library), "utf8"), "");
    const named = Object.values(mtl.materialsInfo).map((m) => m.map_kd);
    check(`${short}.obj`, named.length === 1 && named[0] === `${short}.png`, `its picture is ${named}`);
  } else {
    console.log(`passed over: there is no ${short}.obj`);
  }
  if (existsSync(`${stem}.ply`)) {
    const ply = await readFile(`${stem}.ply`);
    const geometry = new PLYLoader().parse(ply.buffer.slice(ply.byteOffset, ply.byteOffset + ply.length));
    found.ply = facts(geometry, null, false);
    found.ply.bare = !ply.subarray(0, 4096).includes("TextureFile") && geometry.hasAttribute("color");
  } else {
    console.log(`passed over: there is no ${short}.ply`);
  }
  const expected = found.glb;
  const size = expected.box.getSize(new Vector3());
  const longest = Math.max(...size.toArray());
  for (const [ending, f] of Object.entries(found)) {
    const name = `${short}.${ending}`;
    let apart = Math.max(f.box.min.distanceTo(expected.box.min), f.box.max.distanceTo(expected.box.max));
    if (ending === "ply") {
      const sides = (box) => box.getSize(new Vector3()).toArray().sort((a, b) => a - b);
      const [a, b] = [sides(f.box), sides(expected.box)];
      apart = Math.max(...a.map((v, k) => Math.abs(v - b[k])));
    }
    let uv = 0;
    f.uvs.forEach(([u, v], i) => {
      const e = expected.uvs[i] ?? [NaN, NaN];
      uv = Math.max(uv, Math.abs(u - e[0]), Math.abs(v - e[1]));
    });
    console.log(
      `${name.padEnd(22)} ${f.triangles} triangles  box differs by ${(apart / longest).toExponential(1)}` +
        `  closed ${f.closed}  volume ${f.volume.toFixed(9)}  uv differ by ${uv.toExponential(1)}`,
    );
    check(name, apart <= 1e-6 * longest, `its box differs by ${apart}`);
    check(name, f.closed, "not closed");
    check(name, f.volume > 0, `volume ${f.volume}`);
    // a PLY may have colors at its vertices in the texture's place
    if (ending === "ply" && f.bare) continue;
    check(name, f.uvs.length === expected.uvs.length && f.uvs.length > 0, `${f.uvs.length} texture coordinates`);
    check(name, uv <= 1e-6, `texture coordinates differ by ${uv}`);
  }
}
if (process.argv.length < 3) {
  console.log("which files?");
  wrong = 1;
}
process.exit(wrong ? 1 : 0);
