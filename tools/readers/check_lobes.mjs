// Shows a head with lobes in three.js, as docs/viewer does, from the held-out cameras of its run,
// and compares with what `tiface render --with textured` shows from there. In Chromium without a
// window, WebGL in software.
//
//     tiface render RUN --with textured
//     npm ci --prefix tools/readers
//     node tools/readers/check_lobes.mjs RUN [--views 2] [--save DIR]
//
// Compared are pixels that the head covers in both pictures. Checked: PSNR above 35 dB, and above
// that of the base color alone; that docs/viewer/index.html shows the file, without a word from the
// browser and without asking for anything but three.js. --save keeps the pictures:
// NAME_{base,three,tiface}.png. The browser is /usr/bin/chromium, or what CHROMIUM names. Exits 1
// after printing every disagreement.

import { createServer } from "node:http";
import { mkdir, readFile, readdir, writeFile } from "node:fs/promises";
import path from "node:path";
import { fileURLToPath } from "node:url";
import { parseArgs } from "node:util";
import { PNG } from "pngjs";
import { inFile, launch, psnr } from "./pictures.mjs";

const { values, positionals: [run] } = parseArgs({
  allowPositionals: true,
  options: { views: { type: "string", default: "2" }, save: { type: "string" } },
});
if (!run) {
  console.error("usage: node tools/readers/check_lobes.mjs RUN [--views 2] [--save DIR]");
  process.exit(2);
}
const root = path.resolve(path.dirname(fileURLToPath(import.meta.url)), "../..");
const cdn = /^https:\/\/cdn\.jsdelivr\.net\/npm\/three@([^/]+)\//;
const least = 35;

let wrong = 0;
const check = (name, right, what) => {
  if (!right) {
    console.log(`WRONG ${name}: ${what}`);
    wrong += 1;
  }
};

/** What docs/viewer/index.html imports, from the machine itself: the same version of three.js. */
const installed = async (url) => {
  const [, version] = cdn.exec(url);
  const folder = path.join(root, "tools/readers/node_modules/three");
  const own = JSON.parse(await readFile(path.join(folder, "package.json"), "utf8")).version;
  check("docs/viewer/index.html", version === own, `three.js ${version}, but tools/readers has ${own}`);
  return { body: await readFile(path.join(folder, url.replace(cdn, ""))), contentType: "text/javascript" };
};

const kinds = { ".html": "text/html", ".js": "text/javascript", ".glb": "model/gltf-binary" };
const server = createServer(async (request, response) => {
  const name = new URL(request.url, "http://x").pathname;
  const file = name === "/head.glb" ? path.join(run, "mesh/head.glb") : path.join(root, "docs/viewer", path.basename(name));
  try {
    const body = await readFile(file);
    response.writeHead(200, { "content-type": kinds[path.extname(file)] ?? "text/plain" }).end(body);
  } catch {
    response.writeHead(404).end();
  }
});
await new Promise((ready) => server.listen(0, "127.0.0.1", ready));
const origin = `http://127.0.0.1:${server.address().port}`;

/** In the page: pictures of the head, with lobes and without, as data URLs. */
async function pictures(cameras) {
  const { Matrix4, PerspectiveCamera, Scene, Vector3, WebGLRenderer } = await import("three");
  const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
  const { addLobes } = await import("./lobes.js");
  const gltf = await new GLTFLoader().loadAsync("/head.glb");
  const strength = await addLobes(gltf);
  // the scene turns the head and the camera alike: directions must still be those of the file
  const turn = new Matrix4().makeRotationAxis(new Vector3(1, 2, 3).normalize(), 1).multiply(new Matrix4().makeScale(2, 2, 2));
  gltf.scene.applyMatrix4(turn);
  const scene = new Scene();
  scene.add(gltf.scene);
  const renderer = new WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: true });
  return cameras.map((c) => {
    renderer.setSize(c.width, c.height, false);
    const [near, far] = [0.02, 200];
    const camera = new PerspectiveCamera();
    // OpenGL's frustum of a pinhole whose principal point is off the middle
    camera.projectionMatrix.makePerspective(
      -c.cx / c.fx * near, (c.width - c.cx) / c.fx * near, c.cy / c.fy * near, (c.cy - c.height) / c.fy * near, near, far);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    new Matrix4().multiplyMatrices(turn, new Matrix4().fromArray(c.pose)).decompose(camera.position, camera.quaternion, new Vector3());
    const shot = (value) => {
      strength.value = value;
      renderer.render(scene, camera);
      return renderer.domElement.toDataURL("image/png");
    };
    return { three: shot(1), base: shot(0) };
  });
}

/** The same of the pixels that the head covers in part: its outline, and what is soft around it. Over black. */
function outline(a, b) {
  let [sum, n] = [0, 0];
  for (let i = 0; i < a.data.length; i += 4) {
    const [p, q] = [a.data[i + 3], b.data[i + 3]];
    if (![p, q].some((alpha) => alpha > 0 && alpha < 255)) continue;
    for (let k = 0; k < 3; k++) sum += ((a.data[i + k] * p - b.data[i + k] * q) / 255) ** 2;
    n += 3;
  }
  return 10 * Math.log10(255 ** 2 / (sum / n));
}

const described = JSON.parse(await readFile(path.join(run, "cameras.json"), "utf8"));
const folder = path.join(run, "render/textured");
const rendered = new Set(await readdir(folder));
const views = described.views
  .filter(({ name, camera }) => rendered.has(`${name}.png`) && Object.values(camera.distortion).every((v) => v === 0))
  .slice(0, Number(values.views));
check(folder, views.length > 0, "no picture of an undistorted camera");

const browser = await launch();
try {
  const page = await browser.newPage({ viewport: { width: 400, height: 400 } });
  const asked = [], said = [];
  await page.route("**", async (route) => {
    const url = route.request().url();
    if (cdn.test(url)) return route.fulfill(await installed(url));
    if (url.startsWith(origin) || /^(blob|data):/.test(url)) return route.continue();
    asked.push(url);
    return route.abort();
  });
  page.on("pageerror", (e) => said.push(e.message));
  page.on("console", (m) => ["error", "warning"].includes(m.type()) && said.push(m.text()));
  await page.goto(`${origin}/index.html?glb=head.glb`);
  const text = await (await page.waitForFunction(() => {
    const shown = !document.querySelector("[type=checkbox]").disabled;
    return shown ? "shown" : document.querySelector("[role=status]").textContent;
  }, null, { timeout: 120_000 })).jsonValue();
  if (text !== "shown") throw new Error(`docs/viewer/index.html says: ${text}`);
  const shots = await page.evaluate(pictures, views.map((view) => inFile(view.camera, described)));
  check("docs/viewer/index.html", said.length === 0, said.join("\n"));
  check("docs/viewer/index.html", asked.length === 0, `asks for ${asked}`);
  if (values.save) {
    await mkdir(values.save, { recursive: true });
    await page.screenshot({ path: path.join(values.save, "page.png") });
  }
  for (const [i, { name }] of views.entries()) {
    const bytes = { tiface: await readFile(path.join(folder, `${name}.png`)) };
    for (const which of ["three", "base"]) bytes[which] = Buffer.from(shots[i][which].split(",")[1], "base64");
    const picture = Object.fromEntries(Object.entries(bytes).map(([which, png]) => [which, PNG.sync.read(png)]));
    const [lobes, base] = [psnr(picture.three, picture.tiface), psnr(picture.base, picture.tiface)];
    console.log(`view ${name}: three.js is ${lobes.db.toFixed(1)} dB from tiface, its base color ${base.db.toFixed(1)} dB,` +
      ` over ${(100 * lobes.share).toFixed(0)} % of the picture; ${outline(picture.three, picture.tiface).toFixed(1)} dB at its outline`);
    check(name, lobes.share > 0.02, "the head is not in the picture");
    check(name, lobes.db > least && lobes.db > base.db, `expected more than ${least} dB, and more than the base color`);
    if (values.save) {
      for (const [which, png] of Object.entries(bytes)) await writeFile(path.join(values.save, `${name}_${which}.png`), png);
    }
  }
} finally {
  await browser.close();
  server.close();
}
process.exit(wrong ? 1 : 0);
