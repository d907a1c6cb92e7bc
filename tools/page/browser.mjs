// What the programs that try our pages in Chromium share.
//
// The browser is /usr/bin/chromium, or what CHROMIUM names; it has no window.

import { createRequire } from "node:module";
import { mkdtemp, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import path from "node:path";

const require = createRequire(new URL("../readers/package.json", import.meta.url));
const { chromium } = require("playwright-core");

/** Counts disagreements and prints each. */
export function checks() {
  const all = { wrong: 0 };
  all.check = (name, right, what = "") => {
    console.log(`${right ? "ok   " : "WRONG"} ${name}${right ? "" : `: ${what}`}`);
    if (!right) all.wrong += 1;
  };
  all.same = (name, found, expected) =>
    all.check(name, JSON.stringify(found) === JSON.stringify(expected),
      `expected ${JSON.stringify(expected)}, found ${JSON.stringify(found)}`);
  return all;
}

/**
 * Waits until the predicate, a true or false, holds in the page, also while another page is opened.
 * Playwright's own way evaluates text there, which the policy of our pages refuses.
 */
export async function holds(page, predicate) {
  for (const end = Date.now() + 60_000; ; await page.waitForTimeout(50)) {
    if (await page.evaluate(predicate).catch(() => false)) return;
    if (Date.now() > end) throw new Error(`it never holds: ${predicate}`);
  }
}

/**
 * A browser whose pages remember what they asked a network for, and their errors. `gl`: with WebGL, drawn
 * by the CPU. `folder` is for files that are needed meanwhile.
 */
export async function browser({ gl = false } = {}) {
  const profile = await mkdtemp(path.join(tmpdir(), "page-"));
  const args = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync"];
  args.push(...gl ? ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"] : ["--disable-gpu"]);
  const open = async (name, settings = {}) => {
    const context = await chromium.launchPersistentContext(path.join(profile, name), {
      executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", headless: true, args,
      viewport: { width: 1280, height: 800 }, acceptDownloads: true, ...settings });
    const page = context.pages()[0] ?? await context.newPage();
    const asked = [], errors = [];
    page.on("request", (r) => { if (!/^(file|data|blob):/.test(r.url())) asked.push(r.url()); });
    page.on("pageerror", (e) => errors.push(e.message));
    page.on("console", (m) => { if (["error", "warning"].includes(m.type())) errors.push(m.text()); });
    page.on("dialog", (d) => { errors.push(`dialog: ${d.message()}`); d.accept(); });
    return { context, page, asked, errors };
  };
  return { open, folder: profile, close: () => rm(profile, { recursive: true, force: true }) };
}
