// Opens the report of a run as a person would, in Chromium without a window.
//
//     tiface demo --preset draft --set render.method=tface,volume,raycast,textured --run RUN
//     tiface report RUN OTHER --out RUN/runs.html
//     tiface preview RUN --size 512 --out RUN/preview.png
//     tiface preview RUN --size 512 --light seen --out RUN/preview_seen.png
//     npm ci --prefix tools/readers
//     node tools/page/check_report.mjs RUN
//
// If they are there, the page of many runs is tried, too, and the first pictures of the head must
// be those previews, in its colors and by number of cameras.
//
// Checked: the page's size; no errors, nothing asked of a network, no scrolling sideways, at 1280
// and 400 pixels, in light and dark; the head drawn as `tiface` draws it (30 dB); all modes;
// nothing drawn while nothing changes; mouse, touch and keyboard; a browser without WebGL 2; a view
// whose name is made to break the page. How long loading takes is printed. Screenshots go beside
// the page. Exits 1 after printing every disagreement.

import { access, readFile, readdir, stat, writeFile } from "node:fs/promises";
import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";
import { browser, checks, holds } from "./browser.mjs";

const { PNG } = createRequire(new URL("../readers/package.json", import.meta.url))("pngjs");
const LEAST_DB = 30;
const MOST_BYTES = 8e6;

const [run] = process.argv.slice(2);
if (!run) {
  console.error("usage: node tools/page/check_report.mjs RUN");
  process.exit(2);
}
const at = (name) => path.resolve(run, name);
const there = (name) => access(at(name)).then(() => true, () => false);
const all = checks(), { check, same } = all;

/**
 * PSNR of a drawn picture against one of ours, over the pixels that ours covers, laid over the color behind.
 */
function decibels(drawn, ours) {
  const [a, b] = [drawn, ours].map((bytes) => PNG.sync.read(bytes));
  if (a.width !== b.width || a.height !== b.height) return `${a.width} × ${a.height}, ${b.width} × ${b.height}`;
  let sum = 0, count = 0;
  for (let i = 0; i < b.data.length; i += 4) {
    const alpha = b.data[i + 3] / 255;
    if (alpha === 0) continue;
    for (let k = 0; k < 3; k++) sum += (alpha * b.data[i + k] + (1 - alpha) * a.data[k] - a.data[i + k]) ** 2;
    count += 3;
  }
  return -10 * Math.log10(sum / count / 255 ** 2);
}
const bytesOf = (url) => Buffer.from(url.split(",")[1], "base64");
const ready = (page) => holds(page, () => {
  const root = document.querySelector(".viewer");
  return Boolean(root.viewer) || root.classList.contains("dead");
});
/** What the page says of itself after an action. */
const state = (page) => page.evaluate(() => {
  const { yaw, pitch, distance, target, mode, camera, fade } = document.querySelector(".viewer").viewer.state;
  return { yaw, pitch, distance, target: [...target], mode, camera, fade };
});
const settled = (page) => page.waitForTimeout(300);
const finish = async ({ context, asked, errors }, name) => {
  same(`${name}: nothing is asked of a network`, asked, []);
  same(`${name}: no errors`, errors, []);
  await context.close();
};

const { open, close, folder } = await browser({ gl: true });
try {
  const page_url = pathToFileURL(at("report.html")).href;
  const size = (await stat(at("report.html"))).size;
  check(`the page has ${(size / 1e6).toFixed(2)} MB`, size < MOST_BYTES, "8 MB at most");

  for (const [width, scheme] of [[1280, "light"], [400, "dark"], [1280, "dark"], [400, "light"]]) {
    const name = `${width} pixels, ${scheme}`;
    const one = await open(name.replace(/\W/g, ""), { viewport: { width, height: 800 }, colorScheme: scheme, hasTouch: width < 500 });
    const begin = Date.now();
    await one.page.goto(page_url);
    await ready(one.page);
    console.log(`     ${name}: ready after ${Date.now() - begin} ms`);
    same(`${name}: nothing to scroll sideways`, await one.page.evaluate(() => document.documentElement.scrollWidth <= innerWidth), true);
    await one.page.screenshot({ path: at(`report_${width}_${scheme}.png`), fullPage: true });
    await finish(one, name);
  }

  const one = await open("head"), { page } = one;
  await page.goto(page_url);
  await ready(page);
  // the first picture, how many cameras see the surface, and the places of the photographs
  for (const [file, mode] of [["preview.png"], ["preview_seen.png", 5]]) {
    if (!await there(file)) continue;
    const ours = await readFile(at(file)), { width, height } = PNG.sync.read(ours);
    const drawn = bytesOf(await page.evaluate(([w, h, mode]) => {
      const { viewer } = document.querySelector(".viewer"), before = viewer.state.mode;
      viewer.fit(w, h);
      viewer.state.mode = mode ?? before;
      const picture = viewer.picture(w, h);
      viewer.state.mode = before;
      return picture;
    }, [width, height, mode]));
    await writeFile(at(file.replace("preview", "report_first")), drawn);
    const found = decibels(drawn, ours);
    check(`the report shows what \`tiface preview\` drew as ${file}: ${Number(found).toFixed(1)} dB`, found >= LEAST_DB, `at least ${LEAST_DB}`);
  }
  const names = await page.evaluate(() => JSON.parse(document.querySelector(".viewer-data").textContent).cameras.map((c) => c.name));
  const rendered = await there("render/textured") ? await readdir(at("render/textured")) : [];
  for (const [i, view] of names.entries()) {
    if (!rendered.includes(`${view}.png`)) continue;
    const ours = await readFile(at(`render/textured/${view}.png`)), { width, height } = PNG.sync.read(ours);
    const drawn = await page.evaluate(([camera, w, h]) => {
      const { viewer } = document.querySelector(".viewer");
      Object.assign(viewer.state, { camera, fade: 1 });
      return viewer.picture(w, h);
    }, [i, width, height]);
    const found = decibels(bytesOf(drawn), ours);
    check(`${view} is drawn as head.glb is rendered: ${Number(found).toFixed(1)} dB`, found >= LEAST_DB, `at least ${LEAST_DB}`);
  }
  await page.click(".reset");

  // keys alone
  const canvas = page.locator(".viewer canvas");
  await page.evaluate(() => document.activeElement.blur());
  const reached = [];
  for (let i = 0; i < 60; i++) {
    await page.keyboard.press("Tab");
    reached.push(await page.evaluate(() => {
      const e = document.activeElement, style = getComputedStyle(e.closest(".pair") ?? (e.type === "radio" ? e.nextElementSibling : e));
      return { what: e.className || e.name || e.type || e.tagName, seen: style.outlineStyle !== "none" };
    }));
  }
  const order = reached.map((r) => r.what);
  for (const what of ["viewer-mode", "camera", "measure", "save", "reset", "full", "CANVAS", "method", "what", "range", "SUMMARY", "A"]) {
    check(`Tab reaches ${what}`, order.includes(what), order.join(" "));
  }
  same("the focus is always seen", reached.filter((r) => r.what !== "BODY" && !r.seen), []);
  await canvas.focus();
  const change = async (keys, key) => {
    const before = await state(page);
    for (const k of keys) await page.keyboard.press(k);
    const after = await state(page);
    check(`${keys.join(" ")} changes ${key}`, JSON.stringify(before[key]) !== JSON.stringify(after[key]), JSON.stringify(after));
    return after;
  };
  await change(["ArrowLeft"], "yaw");
  await change(["ArrowUp"], "pitch");
  await change(["Shift+ArrowRight"], "target");
  await change(["+"], "distance");
  await change(["-", "-"], "distance");
  for (const mode of [2, 3, 4, 5, 6]) same(`${mode} chooses a mode`, (await change([String(mode)], "mode")).mode, mode - 1);
  await change(["2"], "mode");
  await change(["0"], "distance");
  if (names.length) {
    await change(["]"], "camera");
    await settled(page);
    await change([".", "."], "fade");
    const shown = await page.evaluate(() => getComputedStyle(document.querySelector(".fading")).display);
    same("a photograph can be faded", shown, "block");
    await page.screenshot({ path: at("report_fade.png") });
    same("turning leaves the photograph", (await change(["ArrowRight"], "camera")).camera, -1);
  }

  // mouse; and rest
  const box = await canvas.boundingBox();
  const middle = [box.x + box.width / 2, box.y + box.height / 2];
  const drag = async (key, options = {}) => {
    const before = await state(page);
    await page.mouse.move(...middle);
    await page.mouse.down(options);
    await page.mouse.move(middle[0] + 60, middle[1] + 20, { steps: 4 });
    await page.mouse.up(options);
    const after = await state(page);
    check(`a drag changes ${key}`, JSON.stringify(before[key]) !== JSON.stringify(after[key]));
  };
  await drag("yaw");
  await drag("target", { button: "right" });
  const before = await state(page);
  await page.mouse.wheel(0, -300);
  await settled(page);
  check("the wheel zooms", (await state(page)).distance < before.distance);
  await settled(page);
  const drawn = await page.evaluate(() => document.querySelector(".viewer").viewer.drawn());
  await page.waitForTimeout(500);
  same("nothing is drawn while nothing changes", await page.evaluate(() => document.querySelector(".viewer").viewer.drawn()), drawn);

  // the distance between two points, by keys and by clicks
  await page.click(".reset");
  await canvas.focus();
  const distance = page.locator(".viewer .distance");
  await page.keyboard.press("m");
  await page.keyboard.press("Enter");
  await settled(page);
  same("a point is marked", await page.locator(".mark:visible").count(), 1);
  await page.mouse.click(middle[0], middle[1] - box.height / 8);
  await settled(page);
  // the head fills 95 % of the canvas: an eighth of its height, on a surface that may slant
  const millimeters = parseFloat(await distance.textContent()), tall = await page.evaluate(() => {
    const { viewer } = document.querySelector(".viewer");
    return 2000 * Math.tan(viewer.state.angle / 2) * viewer.state.distance / 8;
  });
  check(`two points are ${await distance.textContent()} apart`, millimeters > 0.5 * tall && millimeters < 3 * tall, `about ${tall.toFixed(1)}`);
  same("both are marked", await page.locator(".mark:visible").count(), 2);
  const marks = await page.locator(".mark").evaluateAll((all) => all.map((m) => {
    const { left, top, width, height } = m.getBoundingClientRect();
    return [left + width / 2, top + height / 2];
  }));
  check("marks lie on their points", Math.hypot(marks[0][0] - middle[0], marks[0][1] - middle[1]) < 2
    && Math.hypot(marks[1][0] - middle[0], marks[1][1] - middle[1] + box.height / 8) < 2, JSON.stringify([marks, middle]));
  await page.screenshot({ path: at("report_measure.png") });
  await page.keyboard.press("m");
  await settled(page);
  same("nothing is left of it", [await page.locator(".mark:visible").count(), await distance.textContent()], [0, ""]);
  // the file of the page
  const [download] = await Promise.all([page.waitForEvent("download"), page.click(".save")]);
  const saved = await readFile(await download.path());
  same("Save GLB saves a GLB", [download.suggestedFilename(), saved.subarray(0, 4).toString(), saved.readUInt32LE(8)], ["head.glb", "glTF", saved.length]);

  // the photographs and what is beside them
  const shownOf = () => page.evaluate(() => [...document.querySelectorAll(".view:first-child .over img")].filter((i) => !i.hidden)
    .map((i) => [i.dataset.method, i.dataset.what]));
  const methods = await page.evaluate(() => [...document.querySelectorAll("[name=method]")].map((i) => i.value));
  for (const method of methods) {
    await page.check(`[name=method][value=${method}]`);
    same(`${method} is shown`, await shownOf(), [[method, "picture"]]);
  }
  if (methods.length > 1) {
    const leftOf = () => page.locator(".pair .left").first().evaluate((i) => !i.hidden && i.alt.length > 0 && i.naturalWidth > 0);
    same("the photograph is on the left", await leftOf(), false);
    await page.selectOption("[name=left]", methods[0]);
    await settled(page);
    same("another picture is on the left", await leftOf(), true);
    await page.selectOption("[name=left]", "");
    same("the photograph is on the left again", await leftOf(), false);
  }
  if (methods.length) {
    await page.check("[name=what][value=error]");
    same("its error is shown", await shownOf(), [[methods.at(-1), "error"]]);
    same("with its scale", await page.locator(".scale").isVisible(), true);
    await page.locator(".pair input").first().focus();
    await page.keyboard.press("Home");
    same("a key moves the border", await page.locator(".pair").first().evaluate((p) => p.style.getPropertyValue("--at")), "0%");
    await page.locator(".views").screenshot({ path: at("report_error.png") });
  }
  await finish(one, "in use");

  // two fingers
  const phone = await open("phone", { viewport: { width: 400, height: 800 }, hasTouch: true, isMobile: true });
  await phone.page.goto(page_url);
  await ready(phone.page);
  await phone.page.locator(".viewer canvas").scrollIntoViewIfNeeded();
  const touch = await phone.context.newCDPSession(phone.page), spot = await phone.page.locator(".viewer canvas").boundingBox();
  const finger = (type, ...points) => touch.send("Input.dispatchTouchEvent", { type, touchPoints: points.map(([x, y], id) => ({ x: spot.x + x, y: spot.y + y, id })) });
  const still = await state(phone.page);
  await finger("touchStart", [100, 100]);
  await finger("touchMove", [140, 110]);
  await finger("touchEnd");
  const turned = await state(phone.page);
  check("one finger turns", turned.yaw !== still.yaw && turned.distance === still.distance);
  await finger("touchStart", [100, 100], [160, 100]);
  await finger("touchMove", [80, 100], [190, 100]);
  await finger("touchEnd");
  check("two fingers zoom", (await state(phone.page)).distance < turned.distance);
  await finish(phone, "touched");

  // a view made to break the page
  const hostile = "<img src=x onerror=document.title=1>";
  const text = (await readFile(at("report.html"), "utf8")).replace(/("cameras":\[\{[^}]*"name":")[^"]*/, (_, head) =>
    head + hostile.replaceAll("<", "\\u003c")).replace(/<option value="0">[^<]*/, () =>
    `<option value="0">${hostile.replaceAll("<", "&lt;")}`);
  await writeFile(path.join(folder, "hostile.html"), text);
  const bad = await open("hostile");
  await bad.page.goto(pathToFileURL(path.join(folder, "hostile.html")).href);
  await ready(bad.page);
  check("a hostile name is text", !["1"].includes(await bad.page.title()) && await bad.page.locator("img[src=x]").count() === 0);
  await finish(bad, "hostile");

  // without WebGL 2
  const bare = await open("bare");
  await bare.page.addInitScript(() => { HTMLCanvasElement.prototype.getContext = () => null; });
  await bare.page.goto(page_url);
  await ready(bare.page);
  check("a browser without WebGL 2 is told", (await bare.page.locator(".message").textContent()).includes("WebGL 2"));
  await finish(bare, "without WebGL 2");

  if (await there("runs.html")) {
    const many = await open("runs");
    await many.page.goto(pathToFileURL(at("runs.html")).href);
    const order = () => many.page.evaluate(() => [...document.querySelectorAll("tbody th")].map((c) => c.textContent));
    const first = await order();
    await many.page.locator("thead button").first().click();
    const up = await order();
    await many.page.locator("thead button").first().click();
    same("a heading sorts", [up, await order()], [[...first].sort((a, b) => a.localeCompare(b)), [...up].reverse()]);
    same("nothing to scroll sideways", await many.page.evaluate(() => document.documentElement.scrollWidth <= innerWidth), true);
    await many.page.screenshot({ path: at("runs.png"), fullPage: true });
    await finish(many, "many runs");

    // five hundred of them, with the names of failed ones
    const page = (await readFile(at("runs.html"), "utf8")).replace(/<tbody>([\s\S]*?<\/tr>)[\s\S]*<\/tbody>/, (_, row) => {
      const rows = Array.from({ length: 500 }, (_, i) => row.replace(/(<th scope="row">.*?>)[^<]+(<)/, `$1head ${i}$2`)
        .replace(/data-state="\w+"/, `data-state="${i % 50 ? "done" : "failed"}"`));
      return `<tbody>${rows.join("")}</tbody>`;
    });
    check(`500 runs have ${(page.length / 1e6).toFixed(2)} MB`, page.length < 6e6, "6 MB at most");
    await writeFile(path.join(folder, "runs.html"), page);
    for (const [width, scheme] of [[1400, "light"], [400, "dark"]]) {
      const fleet = await open(`fleet ${width}`, { viewport: { width, height: 800 }, colorScheme: scheme });
      const begin = Date.now();
      await fleet.page.goto(pathToFileURL(path.join(folder, "runs.html")).href);
      const rows = () => fleet.page.evaluate(() => [...document.querySelectorAll("tbody tr")].filter((r) => !r.hidden).map((r) => r.children[1].textContent));
      const names = (from, to) => Array.from({ length: to - from }, (_, i) => `head ${from + i}`);
      same("a page of runs", await rows(), names(0, 25));
      console.log(`     500 runs, ${width} pixels: ready after ${Date.now() - begin} ms`);
      check("at most three screens", await fleet.page.evaluate(() => document.documentElement.scrollHeight) <= 3 * 800);
      same("nothing to scroll sideways", await fleet.page.evaluate(() => document.documentElement.scrollWidth <= innerWidth), true);
      // keys alone
      await fleet.page.locator(".next").focus();
      await fleet.page.keyboard.press("Enter");
      same("the next page", await rows(), names(25, 50));
      await fleet.page.locator("[name=search]").focus();
      await fleet.page.keyboard.type("head 49");
      same("a search", await rows(), names(0, 500).filter((name) => name.includes("49")));
      await fleet.page.keyboard.type(" nothing");
      same("a search for nothing", [await rows(), await fleet.page.locator(".shown").textContent()], [[], "no run"]);
      await fleet.page.locator("[name=search]").fill("");
      await fleet.page.selectOption("[name=state]", "failed");
      same("failed runs", await rows(), Array.from({ length: 10 }, (_, i) => `head ${50 * i}`));
      const sticky = await fleet.page.evaluate(() => {
        document.querySelector(".scroll").scrollTo(0, 300);
        const [heading, scroll] = ["thead th", ".scroll"].map((q) => document.querySelector(q).getBoundingClientRect().top);
        return Math.abs(heading - scroll) < 3;
      });
      same("the heading stays", sticky, true);
      await fleet.page.screenshot({ path: at(`runs_500_${width}.png`) });
      await finish(fleet, `500 runs, ${width} pixels`);
    }
  }
} finally {
  await close();
}
console.log(all.wrong ? `${all.wrong} disagreements` : "the report does what it should");
process.exit(all.wrong ? 1 : 0);
