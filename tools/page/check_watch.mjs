// Looks at the page that `tiface preview --watch` keeps in a run, in Chromium without a window.
//
//     node tools/page/check_watch.mjs TIFACE RUN
//
// Checked: the page with its stages and curves; that it renews itself; pictures; the report
// behind it; that Ctrl-C ends the command, and the page says so. Exits 1 after printing every
// disagreement.

import { spawn } from "node:child_process";
import { appendFile, mkdtemp, cp, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import path from "node:path";
import { pathToFileURL } from "node:url";
import { browser, checks, holds } from "./browser.mjs";

const [tiface, run] = process.argv.slice(2);
if (!run) {
  console.error("usage: node tools/page/check_watch.mjs TIFACE RUN");
  process.exit(2);
}
const all = checks(), { check, same } = all;
const { open, close } = await browser({ gl: true });
const copy = await mkdtemp(path.join(tmpdir(), "watch-"));
let command;
try {
  // a copy that can be changed
  await cp(run, copy, { recursive: true, filter: (file) => !/surface\.ply$|safetensors$|float$/.test(file) });
  await rm(path.join(copy, "iface/done.json"));
  command = spawn(tiface, ["preview", "--watch", copy, "--json"]);
  const ended = new Promise((resolve) => command.on("exit", resolve));
  const file = await new Promise((resolve) => command.stdout.once("data", (line) => resolve(JSON.parse(line).page)));
  const url = pathToFileURL(path.dirname(path.resolve(file))).href, address = pathToFileURL(path.resolve(file)).href;
  const { page, context, asked, errors } = await open("watch");
  await page.goto(address);
  same("all stages are there", (await page.locator(".bars span:nth-child(3n+1)").allTextContents()).includes("iface"), true);
  const curves = await page.locator(".chart").count();
  check("there are curves", curves > 0);
  check("and views", await page.evaluate(async () => {
    const pictures = [...document.querySelectorAll(".newest img")];
    await Promise.all(pictures.map((i) => i.decode()));
    return pictures.length > 0 && pictures.every((i) => i.naturalWidth > 0);
  }));
  await appendFile(path.join(copy, "iface/log.jsonl"), '{"step":1000000,"psnr":77.5}\n');
  await holds(page, () => document.querySelector("main").textContent.includes("77.5"));
  check("the page renews itself", true);
  await page.screenshot({ path: path.join(run, "watch.png"), fullPage: true });
  await page.click('a[href="report.html"]');
  await holds(page, () => Boolean(document.querySelector(".viewer")?.viewer));
  check("the report opens, with its head", true);
  await page.goBack();
  same("no errors", errors, []);
  same("nothing is asked of anybody else", asked.filter((a) => !a.startsWith(url)), []);
  command.kill("SIGINT");
  same("Ctrl-C is a stop", await ended, 130);
  await holds(page, () => document.querySelector("#state").textContent.includes("ended"));
  check("and the page says so", true);
  await context.close();
} finally {
  command?.kill("SIGKILL");
  await close();
  await rm(copy, { recursive: true, force: true });
}
console.log(all.wrong ? `${all.wrong} disagreements` : "the page of a run at work does what it should");
process.exit(all.wrong ? 1 : 0);
