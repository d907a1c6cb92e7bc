// How the two materials of a head look in three.js under light that people have: decibels from its own colors.
//
//     tiface export RUN --material unlit --out unlit.glb
//     tiface export RUN --material lit --out lit.glb
//     tiface render RUN --with textured
//     npm ci --prefix tools/readers
//     node tools/readers/material_three.mjs RUN unlit.glb lit.glb [--save DIR]
//
// Each file is shown from the first held-out camera: in a scene without light, in the room that
// most viewers put around a model (RoomEnvironment), and in even light from everywhere. Compared
// with what `tiface render --with textured` shows from there, over pixels that both cover. In
// Chromium without a window, WebGL in software.

import { createServer } from "node:http";
import { mkdir, readFile, readdir, writeFile } from "node:fs/promises";
import path from "node:path";
import { fileURLToPath } from "node:url";
import { parseArgs } from "node:util";
import { PNG } from "pngjs";
import { inFile, launch, psnr } from "./pictures.mjs";

const { values, positionals: [run, unlit, lit] } = parseArgs({
  allowPositionals: true,
  options: { save: { type: "string" } },
});
if (!lit) {
  console.error("usage: node tools/readers/material_three.mjs RUN unlit.glb lit.glb [--save DIR]");
  process.exit(2);
}
const modules = path.join(path.dirname(fileURLToPath(import.meta.url)), "node_modules");
const files = { "/unlit.glb": unlit, "/lit.glb": lit };
const page = `<!doctype html><meta charset="utf-8"><script type="importmap">{"imports":
  {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}</script>`;
const server = createServer(async (request, response) => {
  const name = new URL(request.url, "http://x").pathname;
  if (name === "/") return response.writeHead(200, { "content-type": "text/html" }).end(page);
  try {
    const body = await readFile(files[name] ?? path.join(modules, path.normalize(name)));
    response.writeHead(200, { "content-type": name.endsWith(".js") ? "text/javascript" : "model/gltf-binary" }).end(body);
  } catch {
    response.writeHead(404).end();
  }
});
await new Promise((ready) => server.listen(0, "127.0.0.1", ready));

/** In the page: pictures of both files in each light, as data URLs. */
async function pictures(c) {
  const { AmbientLight, Matrix4, PerspectiveCamera, PMREMGenerator, Scene, Vector3, WebGLRenderer } = await import("three");
  const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
  const { RoomEnvironment } = await import("three/addons/environments/RoomEnvironment.js");
  const renderer = new WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: true });
  renderer.setSize(c.width, c.height, false);
  const camera = new PerspectiveCamera();
  const [near, far] = [0.02, 200];
  camera.projectionMatrix.makePerspective(
    -c.cx / c.fx * near, (c.width - c.cx) / c.fx * near, c.cy / c.fy * near, (c.cy - c.height) / c.fy * near, near, far);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  new Matrix4().fromArray(c.pose).decompose(camera.position, camera.quaternion, new Vector3());
  const room = new PMREMGenerator(renderer).fromScene(new RoomEnvironment(), 0.04).texture;
  const out = {};
  for (const which of ["unlit", "lit"]) {
    const gltf = await new GLTFLoader().loadAsync(`/${which}.glb`);
    for (const light of ["none", "room", "even"]) {
      const scene = new Scene();
      scene.add(gltf.scene);
      if (light === "room") scene.environment = room;
      if (light === "even") scene.add(new AmbientLight(0xffffff, Math.PI));
      renderer.render(scene, camera);
      out[`${light} ${which}`] = renderer.domElement.toDataURL("image/png");
    }
  }
  return out;
}

const described = JSON.parse(await readFile(path.join(run, "cameras.json"), "utf8"));
const folder = path.join(run, "render/textured");
const rendered = new Set(await readdir(folder));
const view = described.views.find(({ name }) => rendered.has(`${name}.png`));
const truth = PNG.sync.read(await readFile(path.join(folder, `${view.name}.png`)));
const browser = await launch();
try {
  const tab = await browser.newPage({ viewport: { width: 400, height: 400 } });
  await tab.goto(`http://127.0.0.1:${server.address().port}/`);
  const shots = await tab.evaluate(pictures, inFile(view.camera, described));
  if (values.save) await mkdir(values.save, { recursive: true });
  console.log("| light | unlit | lit |\n|---|---|---|");
  for (const light of ["none", "room", "even"]) {
    const found = [];
    for (const which of ["unlit", "lit"]) {
      const bytes = Buffer.from(shots[`${light} ${which}`].split(",")[1], "base64");
      if (values.save) await writeFile(path.join(values.save, `${light}_${which}.png`), bytes);
      found.push(`${psnr(PNG.sync.read(bytes), truth).db.toFixed(1)} dB`);
    }
    console.log(`| ${light} | ${found.join(" | ")} |`);
  }
} finally {
  await browser.close();
  server.close();
}
