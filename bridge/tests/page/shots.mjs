// Makes the pictures of the documentation from a bridge that runs, such as the demo:
//
//   fatek-bridge demo --http 127.0.0.1:9187 --quiet &
//   node shots.mjs http://127.0.0.1:9187/ ../../docs/images

import { setTimeout as sleep } from "node:timers/promises";
import { start, url, useFiles } from "./driver.mjs";

const folder = process.argv[3] ?? ".";
/** The time that lines need to fill. */
const WAIT_MS = Number(process.env.WAIT_MS ?? 120_000);

const browser = await start();
const pages = [];
for (const [name, width, height, colorScheme] of [
  ["page-light", 1280, 860, "light"],
  ["page-dark", 1280, 860, "dark"],
  ["page-narrow", 320, 720, "light"],
]) {
  const context = await browser.newContext({ viewport: { width, height }, colorScheme });
  await useFiles(context);
  const page = await context.newPage();
  await page.goto(url);
  await page.locator("[data-connection=live]").waitFor();
  pages.push([name, page]);
}
await sleep(WAIT_MS);
for (const [name, page] of pages) await page.screenshot({ path: `${folder}/${name}.png` });
await browser.close();
process.exit();
