// Shared by the scripts: the browser, and the requests to the Rust test that started the script.

import { existsSync, readFileSync } from "node:fs";
import { createInterface } from "node:readline";
import { chromium } from "playwright-core";

export const url = process.argv[2];

const lines = createInterface({ input: process.stdin })[Symbol.asyncIterator]();

/** Asks the test to do something with bridge or PLCs, and waits until it is done. */
export async function ask(request) {
  console.log(`@${request}`);
  const { value } = await lines.next();
  if (value !== "done") throw new Error(`the test answered ${value}`);
}

/** Starts Chromium. It must not ask anything of the network by itself. */
export function start() {
  return chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: [
      "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
      "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
    ],
  });
}

/** With $PAGE_FILES, a folder, the files of the page come from there: a change of them needs no build. */
export async function useFiles(context) {
  const folder = process.env.PAGE_FILES;
  if (!folder) return;
  const types = { css: "text/css", js: "text/javascript", html: "text/html" };
  await context.route("**/*", route => {
    const name = new URL(route.request().url()).pathname.slice(1) || "index.html";
    const contentType = types[name.split(".").pop()];
    if (!contentType || !existsSync(`${folder}/${name}`)) return route.continue();
    return route.fulfill({ contentType, body: readFileSync(`${folder}/${name}`) });
  });
}
