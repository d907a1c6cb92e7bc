// What checks of pictures in three.js share: a browser, cameras of a run in the axes of its file,
// and how far pictures differ.

import { chromium } from "playwright-core";
import { Matrix4, Quaternion, Vector3 } from "three";

/** Chromium without a window, WebGL in software; /usr/bin/chromium, or what CHROMIUM names. */
export const launch = () => chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", headless: true,
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync"],
});

/** A camera of the run in the file's axes and meters: +Y up. */
export function inFile(camera, { up, unit_m: unit }) {
  const turn = new Matrix4().makeRotationFromQuaternion(
    new Quaternion().setFromUnitVectors(new Vector3(...up).normalize(), new Vector3(0, 1, 0)));
  const r = camera.rotation; // columns
  const pose = new Matrix4().set(r[0], r[3], r[6], 0, r[1], r[4], r[7], 0, r[2], r[5], r[8], 0, 0, 0, 0, 1)
    .setPosition(new Vector3(...camera.position).multiplyScalar(unit));
  return { ...camera, pose: turn.multiply(pose).elements };
}

/** PSNR in dB of the pixels that both pictures cover. */
export function psnr(a, b) {
  let [sum, n] = [0, 0];
  for (let i = 0; i < a.data.length; i += 4) {
    if (a.data[i + 3] < 255 || b.data[i + 3] < 255) continue;
    for (let k = 0; k < 3; k++) sum += (a.data[i + k] - b.data[i + k]) ** 2;
    n += 3;
  }
  return { db: 10 * Math.log10(255 ** 2 / (sum / n)), share: n / 3 / (a.data.length / 4) };
}
