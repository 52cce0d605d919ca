// Makes the pictures of the documentation, and those that show the page's other forms, in the folder $SHOTS.

import { setTimeout as sleep } from "node:timers/promises";
import { ask, start, url, useFiles } from "./driver.mjs";

const folder = process.env.SHOTS ?? ".";
const browser = await start();

async function page(width, height, colorScheme) {
  const context = await browser.newContext({ viewport: { width, height }, colorScheme });
  await useFiles(context);
  const page = await context.newPage();
  page.on("console", message => console.log(message.text()));
  page.on("pageerror", error => console.log(String(error)));
  await page.goto(url);
  await page.locator("[data-connection=live]").waitFor();
  return page;
}

await sleep(Number(process.env.SHOTS_AFTER ?? 60) * 1000);
const light = await page(1280, 860, "light");
const dark = await page(1280, 860, "dark");
const narrow = await page(320, 720, "light");
const narrowDark = await page(320, 720, "dark");
await sleep(4000);
await light.screenshot({ path: `${folder}/light.png` });
await dark.screenshot({ path: `${folder}/dark.png` });
await narrow.screenshot({ path: `${folder}/narrow.png`, fullPage: false });
await narrow.locator("#plcs").scrollIntoViewIfNeeded();
await narrow.evaluate(() => scrollTo(0, document.getElementById("plcs").offsetTop));
await sleep(500);
await narrow.screenshot({ path: `${folder}/narrow-tags.png` });
await narrowDark.evaluate(() => scrollTo(0, document.querySelector("aside").offsetTop));
await sleep(500);
await narrowDark.screenshot({ path: `${folder}/narrow-aside.png` });
await light.getByRole("button", { name: "level", exact: true }).click();
await sleep(1200);
await light.screenshot({ path: `${folder}/detail.png` });
await light.keyboard.press("Escape");
await ask("stop mixer");
await sleep(3500);
await light.screenshot({ path: `${folder}/stopped.png` });
await dark.screenshot({ path: `${folder}/stopped-dark.png` });
await ask("kill bridge");
await sleep(3000);
await light.screenshot({ path: `${folder}/lost.png` });
await dark.screenshot({ path: `${folder}/lost-dark.png` });
await browser.close();
process.exit();
