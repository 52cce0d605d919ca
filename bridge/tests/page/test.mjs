// Checks of the page in headless Chromium. Exits with 1 if one fails.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { setTimeout as sleep } from "node:timers/promises";
import { ask, start, url, useFiles } from "./driver.mjs";

const axe = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");
const host = new URL(url).host;
const browser = await start();
/** Errors of the page, and requests to other hosts, of all checks. */
const complaints = [];
let failures = 0;
/** The contexts of pages that one check alone uses. */
const contexts = [];

/** The longest wait for anything: on a machine with seven times the work that it has processors for, 60 s failed. */
const PATIENCE = 180_000;

/** Opens the page. `expected`: errors of the console that belong to the check. */
async function open({ width = 1280, height = 900, colorScheme = "light", bypassCSP = false, expected = null } = {}) {
  const context = await browser.newContext({ viewport: { width, height }, colorScheme, bypassCSP });
  contexts.push(context);
  context.setDefaultTimeout(PATIENCE);
  await useFiles(context);
  const page = await context.newPage();
  page.on("console", message => {
    if (["error", "warning"].includes(message.type()) && !expected?.test(message.text())) complaints.push(message.text());
  });
  page.on("pageerror", error => complaints.push(String(error)));
  page.on("request", request => new URL(request.url()).host !== host && complaints.push(`requested ${request.url()}`));
  await page.goto(url);
  await page.locator("[data-connection=live]").waitFor();
  return page;
}

async function check(name, act) {
  const began = performance.now();
  try {
    await act();
    console.log(`ok    ${name} (${Math.round(performance.now() - began)} ms)`);
  } catch (error) {
    failures += 1;
    console.log(`FAILS ${name}\n${error.stack}`);
  }
  for (const context of contexts.splice(0)) await context.close();
}

/** The row of a tag of the mixer. */
function rowOf(page, tag) {
  return page.locator("#tags-mixer .row", { has: page.getByRole("button", { name: tag, exact: true }) });
}

/** Waits until a function of the page returns a true value. */
async function until(what, act, limit = PATIENCE) {
  const end = performance.now() + limit;
  for (;;) {
    const result = await act();
    if (result) return result;
    assert.ok(performance.now() < end, `${what}: not within ${limit} ms`);
    await sleep(100);
  }
}

async function violations(page) {
  await page.evaluate(axe);
  const { violations } = await page.evaluate(() => globalThis.axe.run(document));
  return violations.map(({ id, nodes }) => `${id}: ${nodes.slice(0, 3).map(node => `${node.html} ${node.failureSummary}`).join("\n")}`);
}

function assertNoOverflow(page) {
  return page.evaluate(() => {
    const { scrollWidth, clientWidth } = document.documentElement;
    const wide = [...document.querySelectorAll("body *")]
      .filter(element => element.getBoundingClientRect().right > clientWidth + 1 && !element.closest(".hidden, .head"))
      .map(element => element.outerHTML.slice(0, 120));
    return { scrollWidth, clientWidth, wide: wide.slice(0, 5) };
  }).then(({ scrollWidth, clientWidth, wide }) => {
    assert.ok(scrollWidth <= clientWidth, `the page is ${scrollWidth} wide in ${clientWidth}: ${wide.join("\n")}`);
    assert.deepEqual(wide, []);
  });
}

const page = await open({ expected: /ERR_CONNECTION_REFUSED|ERR_INCOMPLETE_CHUNKED_ENCODING|ERR_CONNECTION_RESET|ERR_EMPTY_RESPONSE/ });
// It is the page of all checks.
contexts.pop();

await check("values move, and those of texts and lists are shown", async () => {
  const level = rowOf(page, "level").locator(".number");
  await until("a value of level", async () => /^\d+(\.\d)?$/.test(await level.textContent()));
  const first = await level.textContent();
  await until("another value of level", async () => (await level.textContent()) !== first);
  await until("the name", async () => (await rowOf(page, "name").locator(".number").textContent()) === "Mixer 2 <b>");
  await until("the recipe", async () => /^0, 0, 0, 0, 0, 0, … \(10\)$/.test(await rowOf(page, "recipe").locator(".number").textContent()));
  await until("the discrete", async () => /^(on|off)$/.test(await rowOf(page, "running").locator(".number").textContent()));
  assert.equal(await rowOf(page, "level").locator(".unit").textContent(), "%");
  await until("its age", async () => parseFloat(await rowOf(page, "level").locator(".age").textContent()) < 3);
});

await check("texts of the configuration are texts", async () => {
  await until("the comment", async () =>
    (await rowOf(page, "total").locator(".note").textContent()) === "<img src=x onerror=alert(1)>");
  assert.equal(await page.locator("main img").count(), 0);
});

await check("a sparkline grows", async () => {
  const points = () => rowOf(page, "level").locator("svg").getAttribute("data-points").then(Number);
  const first = await until("the first points", points);
  await until("more points", async () => (await points()) > first);
  assert.match(await rowOf(page, "level").locator(".line").getAttribute("d"), /^M[\d.]+ [\d.]+/);
  // A page that is opened later has the points from before.
  const later = await open();
  await until("points of the server", async () =>
    Number(await rowOf(later, "level").locator("svg").getAttribute("data-points")) >= first);
});

await check("figures of PLCs, links, outputs and buffer are there", async () => {
  await until("the round trip", async () => /ms$/.test(await page.locator(".plc .round-trip").first().textContent()));
  await until("all PLCs online", async () => (await page.locator("[data-figure=plcs] dd").textContent()).trim() === "3 of 3");
  await until("the rate", async () => parseFloat(await page.locator("[data-figure=samples] b").textContent()) > 0);
  assert.equal(await page.locator("#links .item").count(), 3);
  await until("the load", async () => /load \d|load <1/.test(await page.locator("#links .facts-line").first().textContent()));
  assert.match(await page.locator("#outputs .item").first().textContent(), /stdout\s*connected/);
  assert.match(await page.locator("#buffer .facts-line").textContent(), /of 64 MiB in memory · no disk/);
});

await check("the quality changes when a PLC stops, and again when it is back", async () => {
  const row = rowOf(page, "level");
  const mixer = page.locator(".plc", { has: page.getByText("mixer", { exact: true }) });
  // Noted by the page itself, since the tag is stale for two seconds only.
  await row.evaluate(element => {
    globalThis.seen = [];
    const text = name => element.querySelector(name).textContent;
    const note = () => globalThis.seen.push([element.dataset.state, text(".number"), text(".note")]);
    new MutationObserver(note).observe(element, { attributes: true, attributeFilter: ["data-state"] });
  });
  await ask("stop mixer");
  await until("a bad tag", async () => (await row.getAttribute("data-state")) === "bad");
  const stale = (await page.evaluate(() => globalThis.seen)).find(([state]) => state === "stale");
  assert.ok(stale, "the tag is stale before it is bad");
  assert.match(stale[1], /^\d/, "a stale tag keeps its value");
  assert.notEqual(stale[2].trim(), "", "the reason is shown");
  assert.equal(await row.locator(".number").textContent(), "–", "a bad tag has no value");
  await until("the state of the PLC", async () => (await mixer.locator(".fold .mark").getAttribute("data-state")) === "bad");
  await page.locator("#not-good").check();
  assert.equal(await page.locator(".plc:visible").count(), 1, "only the PLC with tags that are not good is shown");
  await page.locator("#not-good").uncheck();
  await ask("resume mixer");
  await until("a good tag", async () => (await row.getAttribute("data-state")) === "good");
  await until("the state of the PLC", async () => (await mixer.locator(".fold .mark").getAttribute("data-state")) === "good");
});

await check("9,000 tags of a PLC are usable", async () => {
  const began = performance.now();
  await page.locator("#filter").fill("store place-89");
  await until("the matches", async () => (await page.locator("#matches").textContent()) === "100 of 9,010 tags");
  await until("a row", async () => (await page.locator("#tags-store .row").filter({ hasText: "place-8900" }).count()) === 1);
  await page.locator("#filter").fill("");
  await page.locator(".fold", { hasText: "store" }).click();
  await page.evaluate(() => scrollTo(0, document.body.scrollHeight));
  await until("the last row", async () => (await page.locator("#tags-store .row").filter({ hasText: "place-8999" }).count()) === 1);
  const rows = await page.locator(".rows .row").count();
  assert.ok(rows < 400, `${rows} rows exist`);
  await until("a value", async () => /^(on|off|\d+)$/.test(await page.locator("#tags-store .row", { hasText: "place-8990" }).locator(".number").textContent()));
  const found = performance.now() - began;
  // The longest time in which the page could not react, of 8 s in which 7,680 values change each 2 s.
  const longest = await page.evaluate(async () => {
    const end = performance.now() + 8000;
    let longest = 0;
    for (let last = performance.now(); last < end;) {
      await new Promise(resolve => setTimeout(resolve, 10));
      longest = Math.max(longest, performance.now() - last);
      last = performance.now();
    }
    return longest;
  });
  console.log(`      the page was busy for ${Math.round(longest)} ms at most`);
  console.log(`      found, unfolded and scrolled in ${Math.round(found)} ms, with ${rows} rows`);
  await page.evaluate(() => scrollTo(0, 0));
  await page.locator(".fold", { hasText: "store" }).click();
});

await check("a tag in detail, and back with the keyboard", async () => {
  const button = page.getByRole("button", { name: "setpoint", exact: true });
  await button.focus();
  await page.keyboard.press("Enter");
  await page.locator("dialog[open]").waitFor();
  assert.match(await page.locator("#detail-facts").textContent(), /AddressR200:f32.*Writableyes, from 0 to 80/);
  const value = await page.locator("#detail-value").textContent();
  await until("another value", async () => (await page.locator("#detail-value").textContent()) !== value);
  assert.deepEqual(await violations(page), []);
  await page.keyboard.press("Escape");
  assert.ok(await button.evaluate(element => element === document.activeElement), "the focus is where it was");
});

await check("the keyboard alone reaches everything, and the focus can be seen", async () => {
  const fresh = await open({ width: 1280 });
  await rowOf(fresh, "level").waitFor();
  const wanted = await fresh.evaluate(() => {
    const controls = [...document.querySelectorAll("a, button, input, [tabindex='0']")];
    const reachable = controls.filter(element => element.checkVisibility() && !element.closest("dialog"));
    reachable.forEach((element, index) => (element.dataset.test = String(index)));
    return reachable.length;
  });
  const reached = new Set();
  for (let step = 0; step < wanted + 20 && reached.size < wanted; step++) {
    await fresh.keyboard.press("Tab");
    const { test, isVisible } = await fresh.evaluate(() => {
      const element = document.activeElement;
      const { outlineStyle, outlineWidth } = getComputedStyle(element);
      const box = element.getBoundingClientRect();
      const isInside = box.bottom > 0 && box.top < innerHeight && box.width > 0;
      return { test: element.dataset.test, isVisible: outlineStyle !== "none" && parseFloat(outlineWidth) >= 2 && isInside };
    });
    if (test === undefined) continue;
    assert.ok(isVisible, `the focus on control ${test} cannot be seen`);
    reached.add(test);
  }
  assert.equal(reached.size, wanted, `${reached.size} of ${wanted} controls were reached`);
  console.log(`      ${wanted} controls`);
  // Folding and the filter work by keys.
  const fold = fresh.locator(".fold", { hasText: "boiler" });
  const before = await fold.getAttribute("aria-expanded");
  await fold.focus();
  await fresh.keyboard.press("Space");
  assert.notEqual(await fold.getAttribute("aria-expanded"), before);
  await fresh.locator(".skip").focus();
  await fresh.keyboard.press("Enter");
  assert.equal(await fresh.evaluate(() => document.activeElement.id), "plcs");
});

for (const colorScheme of ["light", "dark"]) {
  for (const width of [1280, 320]) {
    await check(`axe finds nothing at ${width} px, ${colorScheme}`, async () => {
      const other = await open({ width, colorScheme, bypassCSP: true });
      await rowOf(other, "level").waitFor();
      await until("values", async () => (await rowOf(other, "level").getAttribute("data-state")) === "good");
      assert.deepEqual(await violations(other), []);
      await assertNoOverflow(other);
    });
  }
}

await check("nothing overflows at 320 px with a tag in detail, and when a PLC is unfolded", async () => {
  const narrow = await open({ width: 320, height: 640 });
  await narrow.locator("#expand").click();
  await narrow.getByRole("button", { name: "recipe", exact: true }).click();
  await narrow.locator("dialog[open]").waitFor();
  await assertNoOverflow(narrow);
});

await check("a lost connection is shown, and the page connects again by itself", async () => {
  await page.getByRole("button", { name: "level", exact: true }).focus();
  const ageBefore = await rowOf(page, "level").locator(".age").textContent();
  await ask("kill bridge");
  await page.locator("[data-connection=lost]").waitFor();
  await page.locator("#lost").waitFor({ state: "visible" });
  assert.match(await page.locator("#lost").textContent(), /^Connection to the bridge lost .* ago\. All values are those of/);
  assert.equal(await page.locator("#connection").textContent(), "Connection lost");
  assert.match(await page.title(), /^Lost: /);
  const { color, muted } = await rowOf(page, "level").locator(".number").evaluate(element => {
    const probe = document.body.appendChild(document.createElement("i"));
    probe.style.color = "var(--muted)";
    const muted = getComputedStyle(probe).color;
    probe.remove();
    return { color: getComputedStyle(element).color, muted };
  });
  assert.equal(color, muted, "old values are grey");
  await until("an age that grows", async () =>
    parseFloat(await rowOf(page, "level").locator(".age").textContent()) > parseFloat(ageBefore) + 2);
  const axed = await violations(page);
  assert.deepEqual(axed, []);
  await ask("start bridge");
  await page.locator("[data-connection=live]").waitFor();
  await until("a good tag", async () => (await rowOf(page, "level").getAttribute("data-state")) === "good");
  assert.ok(await page.locator("#lost").isHidden());
  const focused = await page.evaluate(() => document.activeElement.textContent);
  assert.equal(focused, "level", "the focus has not moved");
});

await check("no errors in the console, and no requests to other hosts", async () => {
  assert.deepEqual(complaints, []);
});

await browser.close();
console.log(`${failures === 0 ? "all checks passed" : `${failures} checks failed`}`);
process.exit(failures === 0 ? 0 : 1);
