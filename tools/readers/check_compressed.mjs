// Opens a compressed GLB in three.js, whose decoder is meshoptimizer's own, beside the mesh uncompressed.
//
//     tiface export RUN --out plain.glb && tiface export RUN --compress --out small.glb
//     npm ci --prefix tools/readers
//     node tools/readers/check_compressed.mjs small.glb plain.glb
//
// In both: as many triangles and soft layers, box, volume, and area of surface and texture to within the steps
// of 16 bits, closed after welding equal positions, the same kind of material with a picture. Exits 1 after
// printing every disagreement.

import { readFile } from "node:fs/promises";

globalThis.self = globalThis;
globalThis.createImageBitmap = async (blob) => ({ width: blob.size, height: 1, close() {} });
const { Vector2, Vector3, Box3 } = await import("three");
const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
const { MeshoptDecoder } = await import("three/addons/libs/meshopt_decoder.module.js");

/** The number of triangles, the box, and what surface and texture are like. */
function facts({ geometry, matrixWorld }) {
  const [at, uv, index] = [geometry.getAttribute("position"), geometry.getAttribute("uv"), geometry.index];
  const numbers = new Map();
  const edges = new Map();
  const box = new Box3();
  const [corners, uvs] = [[0, 1, 2].map(() => new Vector3()), [0, 1, 2].map(() => new Vector2())];
  let [volume, area, texture] = [0, 0, 0];
  for (let i = 0; i < index.count; i += 3) {
    const weld = [0, 1, 2].map((k) => {
      const v = index.getX(i + k);
      const key = `${at.getX(v)} ${at.getY(v)} ${at.getZ(v)}`;
      if (!numbers.has(key)) numbers.set(key, numbers.size);
      box.expandByPoint(corners[k].fromBufferAttribute(at, v).applyMatrix4(matrixWorld));
      if (uv) uvs[k].fromBufferAttribute(uv, v);
      return numbers.get(key);
    });
    for (let k = 0; k < 3; k++) {
      const edge = `${weld[k]} ${weld[(k + 1) % 3]}`;
      edges.set(edge, (edges.get(edge) ?? 0) + 1);
    }
    const [a, b, c] = corners;
    volume += a.dot(b.clone().cross(c)) / 6;
    area += b.clone().sub(a).cross(c.clone().sub(a)).length() / 2;
    texture += uvs[1].clone().sub(uvs[0]).cross(uvs[2].clone().sub(uvs[0])) / 2;
  }
  const back = (edge) => edges.get(edge.split(" ").reverse().join(" "));
  const closed = [...edges].every(([edge, n]) => n === 1 && back(edge) === 1);
  return { triangles: index.count / 3, box, closed, volume, area, texture };
}

async function opened(path) {
  const bytes = await readFile(path);
  const loader = new GLTFLoader().setMeshoptDecoder(MeshoptDecoder);
  const { buffer, byteOffset, length } = bytes;
  const { scene } = await loader.parseAsync(buffer.slice(byteOffset, byteOffset + length), "");
  scene.updateMatrixWorld(true);
  const meshes = [];
  scene.traverse((o) => o.isMesh && meshes.push(o));
  const [mesh, ...more] = meshes.filter((o) => !o.material.transparent);
  if (more.length) throw new Error(`${path} has ${more.length + 1} meshes, expected 1`);
  const { type, map } = mesh.material;
  const attributes = Object.keys(mesh.geometry.attributes).sort().join(" ");
  const material = `${type} ${map ? "with" : "without"} a picture`;
  return { ...facts(mesh), material, attributes, layers: meshes.length - 1, bytes: length };
}

const [small, plain] = process.argv.slice(2, 4);
const wrong = [];
if (plain) {
  const [found, expected] = [await opened(small), await opened(plain)];
  const longest = Math.max(...expected.box.getSize(new Vector3()).toArray());
  const apart = Math.max(...["min", "max"].map((end) => found.box[end].distanceTo(expected.box[end])));
  console.log(
    `${found.bytes} bytes of ${expected.bytes}  ${found.triangles} triangles` +
      `  box differs by ${(apart / longest).toExponential(1)}  closed ${found.closed}`,
  );
  for (const key of ["triangles", "material", "attributes", "layers", "closed"]) {
    if (found[key] !== expected[key]) wrong.push(`${key}: ${found[key]}, expected ${expected[key]}`);
  }
  if (!(apart <= 1e-4 * longest)) wrong.push(`its box differs by ${apart}`);
  for (const key of ["volume", "area", "texture"]) {
    const share = Math.abs(found[key] / expected[key] - 1);
    console.log(`    ${key} differs by ${share.toExponential(1)}`);
    if (!(share < 1e-3)) wrong.push(`${key}: ${found[key]}, expected ${expected[key]}`);
  }
  if (!(2 * found.bytes < expected.bytes)) wrong.push("not half as large");
} else {
  wrong.push("which files?");
}
for (const line of wrong) console.log(`WRONG ${line}`);
process.exit(wrong.length ? 1 : 0);
