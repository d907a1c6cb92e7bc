// Clicks on the page of `tiface mask --page` as a person would, in Chromium without a window.
//
//     cargo run --release --example click_page -- DIR/page.html
//     npm ci --prefix tools/readers
//     node tools/page/check_page.mjs DIR/page.html
//
// Screenshots go beside the page. Checked: what is saved holds the pixels that were clicked, in
// all three sizes of the picture; right click, Shift, touch and keyboard; undo, redo, removing;
// opening a file, also a senseless one; a file name made to break the page; that nothing is asked
// of a network. Exits 1 after printing every disagreement.

import { readFile, writeFile } from "node:fs/promises";
import path from "node:path";
import { pathToFileURL } from "node:url";
import { browser, checks, holds } from "./browser.mjs";

const [given] = process.argv.slice(2);
if (!given) {
  console.error("usage: node tools/page/check_page.mjs PAGE.html");
  process.exit(2);
}
const file = path.resolve(given);
const beside = (ending) => file.replace(/\.html$/, "") + ending;

const all = checks(), { check, same } = all;
const { open, close, folder: profile } = await browser();
const shape = (page) => page.evaluate(() => JSON.parse(document.getElementById("data").textContent).views
  .map(({ file_path, width, height }) => ({ file_path, width, height })));
/** The middle of a pixel of the original photograph, in the window. */
const spot = async (page, view, x, y) => {
  const box = await page.locator("#picture").boundingBox();
  return [box.x + (x + 0.5) / view.width * box.width, box.y + (y + 0.5) / view.height * box.height];
};
const saved = async (page) => {
  const [download] = await Promise.all([page.waitForEvent("download"), page.click("#save")]);
  same("the file is called prompts.json", download.suggestedFilename(), "prompts.json");
  return JSON.parse(await readFile(await download.path(), "utf8"));
};
/** What is clicked now, as it would be saved: a browser asks before it lets a page save more than ten files. */
const now = (page) => page.evaluate(() => ({ frames: views
  .map((view, i) => ({ file_path: view.file_path, points: points[i] })).filter((f) => f.points.length) }));
const points = (prompts) => prompts.frames.map((f) => [f.file_path, f.points.map((p) => [p.x, p.y, p.label])]);
const status = (page) => page.locator("#status").textContent();

try {
  const { context, page, asked, errors } = await open("plain");
  await page.goto(pathToFileURL(file).href);
  const views = await shape(page);
  check("there are at least two photographs", views.length > 1, `${views.length}`);
  // begin with nothing clicked, whatever the page came with
  for (let i = 0; i < views.length; i++) {
    await page.locator("#list button").nth(i).click();
    if (await page.locator("#clear").isEnabled()) await page.click("#clear");
  }
  const [first, second] = [views[0], views[1]];
  const at = (view, u, v) => [Math.floor(u * view.width), Math.floor(v * view.height)];
  const [face, stage, hair] = [at(first, 0.5, 0.55), at(first, 0.06, 0.1), at(first, 0.45, 0.25)];
  const [other, dark, corner] = [at(second, 0.52, 0.5), at(second, 0.93, 0.08), [0, 0]];

  await page.locator("#list button").nth(0).click();
  await page.mouse.click(...await spot(page, first, ...face));
  await page.mouse.click(...await spot(page, first, ...stage), { button: "right" });
  await page.locator("#list button").nth(1).click();
  await page.mouse.click(...await spot(page, second, ...other));
  await page.keyboard.down("Shift");
  await page.mouse.click(...await spot(page, second, ...dark));
  await page.keyboard.up("Shift");
  const expected = [
    [first.file_path, [[...face, 1], [...stage, 0]]],
    [second.file_path, [[...other, 1], [...dark, 0]]],
  ];
  same("clicks are saved to the pixel", points(await saved(page)), expected);
  await page.screenshot({ path: beside(".png") });

  await page.click("#undo");
  same("undo takes the last click back", points(await now(page))[1], [second.file_path, [[...other, 1]]]);
  await page.click("#redo");
  same("redo brings it again", points(await now(page)), expected);
  await page.mouse.click(...await spot(page, second, ...dark));
  same("a click on a point removes it", points(await now(page))[1], [second.file_path, [[...other, 1]]]);
  await page.click("#not");
  await page.mouse.click(...await spot(page, second, ...corner));
  same("the corner is pixel 0, 0; the button says what a click means", points(await now(page))[1],
    [second.file_path, [[...other, 1], [0, 0, 0]]]);
  await page.click("#clear");
  same("a cleared view is not saved", points(await now(page)).map(([name]) => name), [first.file_path]);
  await page.keyboard.press("Control+z");
  await page.keyboard.press("z");
  await page.keyboard.press("z");
  same("keys undo as far as one likes", points(await saved(page)), expected);

  // larger than the window: the same pixel lies elsewhere
  await page.keyboard.press("h");
  await page.keyboard.press("[");
  await page.keyboard.press("+");
  await page.locator("#stage").evaluate((s) => s.scrollTo(0, 0));
  await page.mouse.click(...await spot(page, first, ...hair));
  await page.keyboard.press("-");
  expected[0][1].push([...hair, 1]);
  same("an enlarged picture gives the same pixels", points(await now(page)), expected);

  await page.locator("#picture").focus();
  for (const key of ["ArrowRight", "Shift+ArrowDown", "ArrowUp", "Enter", "Shift+ArrowLeft", "Shift+Enter"]) {
    await page.keyboard.press(key);
  }
  const [x, y] = [hair[0] + 1, hair[1] + 9];
  same("arrows and Enter set points", points(await now(page))[0][1].slice(3), [[x, y, 1], [x - 10, y, 0]]);
  await page.keyboard.press("Shift+Tab");
  await page.locator("#picture").focus();
  await page.keyboard.press("Delete");
  await page.keyboard.press("Delete");
  await page.keyboard.press("]");
  same("Delete removes what is nearest", points(await saved(page)), expected);

  const prompts = { convention: "", frames: [
    { file_path: second.file_path.replace(/\.\w+$/, ""), points: [{ x: 1.25, y: 2, label: 1 }, { x: 1e9, y: 2, label: 1 }] },
    { file_path: "images/of another capture.png", points: [] } ] };
  const clicks = path.join(profile, "clicks.json");
  await writeFile(clicks, JSON.stringify(prompts));
  await page.setInputFiles("#open", clicks);
  await holds(page, () => document.getElementById("status").textContent.includes("clicks.json"));
  check("what fits no photograph is said", (await status(page)).includes("images/of another capture.png"), await status(page));
  same("a file is opened", points(await saved(page)), [[second.file_path, [[1.25, 2, 1]]]]);
  for (const text of ["{", "[]", '{"frames": 3}', `{"frames": [null, {"file_path": 3}, {"file_path": "${first.file_path}", "points": [null]}]}`]) {
    await writeFile(clicks, text);
    await page.evaluate(() => { document.getElementById("status").textContent = ""; });
    await page.setInputFiles("#open", clicks);
    await holds(page, () => document.getElementById("status").textContent !== "");
    check(`a senseless file is named: ${text}`, await page.evaluate(() => document.getElementById("status").className === "wrong"),
      await status(page));
  }
  same("nothing is asked of a network", asked, []);
  same("the page has no errors", errors, []);
  await context.close();

  // a name made to break out of the script, on a small screen, by touch
  const evil = "images/</script><script>document.title='broken'</script>\"'&\u2028.png";
  const source = await readFile(file, "utf8");
  const data = JSON.parse(source.split('id="data">')[1].split("</script>")[0]);
  data.views[0].file_path = evil;
  data.prompts.frames = [];
  const text = JSON.stringify(data).replaceAll("<", "\\u003c").replaceAll(">", "\\u003e").replaceAll("&", "\\u0026");
  const [before, rest] = source.split('id="data">');
  const hostile = path.join(profile, "hostile.html");
  await writeFile(hostile, before + 'id="data">' + text + rest.slice(rest.indexOf("</script>")));
  const phone = await open("phone", { viewport: { width: 420, height: 800 }, hasTouch: true });
  await phone.page.goto(pathToFileURL(hostile).href);
  check("a hostile name stays a name", (await phone.page.title()).endsWith("clicks"), await phone.page.title());
  same("it is shown as it is", [await phone.page.locator("#list .name").first().textContent(),
    await phone.page.locator("#list button").first().getAttribute("title")], [evil.slice("images/".length), evil]);
  await phone.page.touchscreen.tap(...await spot(phone.page, first, ...face));
  const [tapped] = points(await saved(phone.page));
  check("a tap sets a point within a pixel of the screen", tapped[0] === evil && tapped[1].length === 1
    && Math.hypot(tapped[1][0][0] - face[0], tapped[1][0][1] - face[1]) <= first.width / 300, JSON.stringify(tapped));
  await phone.page.screenshot({ path: beside("_phone.png") });
  same("the page has no errors by touch", phone.errors, []);
  await phone.context.close();
} finally {
  await close();
}
console.log(all.wrong ? `${all.wrong} disagreements` : "the page does what it should");
process.exit(all.wrong ? 1 : 0);
