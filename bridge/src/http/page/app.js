// The page: takes events, and shows them when the browser draws.

import { Aside } from "./aside.js";
import { Detail } from "./detail.js";
import { age, setText } from "./format.js";
import { Model } from "./model.js";
import { PlcList } from "./plcs.js";
import { Stream } from "./stream.js";

const model = new Model();
const detail = new Detail(model);
const list = new PlcList(model, tag => detail.open(tag));
const aside = new Aside();
const connection = document.getElementById("connection");
const lost = document.getElementById("lost");

/** What has changed since the browser drew last. */
const pending = { changed: new Set(), isSlot: false, hasStatus: false, isAsked: false };
/** When the last event came before the connection was lost, if it is. */
let lostAt = null;
let lostTime = "";

function draw() {
  pending.isAsked = false;
  const now = performance.now();
  list.show([...pending.changed], pending.isSlot, now);
  if (pending.hasStatus) showStatus();
  if (pending.isSlot || pending.changed.size > 0) detail.show();
  Object.assign(pending, { changed: new Set(), isSlot: false, hasStatus: false });
}

function ask() {
  if (pending.isAsked) return;
  pending.isAsked = true;
  requestAnimationFrame(draw);
}

function showStatus() {
  list.showStatus();
  aside.show(model.status);
  document.title = `${lostAt === null ? "" : "Lost: "}${model.status.id} – fatek-bridge`;
}

function showLost() {
  const text = `Connection to the bridge lost ${age(performance.now() - lostAt)} ago. `
    + (lostTime ? `All values are those of ${lostTime}. ` : "") + "Connecting again…";
  setText(lost, text);
}

new Stream("events", {
  snapshot(snapshot, now) {
    model.takeSnapshot(snapshot, now);
    pending.changed.clear();
    list.takeSnapshot();
    showStatus();
    detail.show();
  },
  changes(changes, now) {
    const slot = model.slot;
    for (const tag of model.takeChanges(changes, now)) pending.changed.add(tag);
    pending.isSlot ||= model.slot !== slot;
    pending.hasStatus ||= changes.status !== undefined;
    ask();
  },
  live() {
    lostAt = null;
    lost.hidden = true;
    document.documentElement.dataset.connection = "live";
    setText(connection, "Live");
    if (model.status) showStatus();
  },
  lost(heard) {
    lostAt = heard;
    lostTime = model.status ? new Date(Date.now() - (performance.now() - heard)).toLocaleTimeString() : "";
    document.documentElement.dataset.connection = "lost";
    setText(connection, "Connection lost");
    showLost();
    lost.hidden = false;
    if (model.status) showStatus();
  },
});

setInterval(() => {
  if (document.hidden) return;
  list.showAges(performance.now());
  detail.show();
  if (lostAt !== null) showLost();
}, 1000);
