// The list of PLCs with their tags.
//
// A PLC is folded or unfolded. The rows of its tags are made in groups when they come near the window, and
// removed when they leave it, so that 10,000 tags cost no more than those that are seen.

import * as format from "./format.js";
import { draw } from "./spark.js";

/** The rows of a group. */
const GROUP = 50;
/** How far from the window rows are made. */
const MARGIN = "600px 0px";
/** PLCs are unfolded at first up to this number of tags. */
const UNFOLDED_TAGS = 100;

const plcTemplate = document.getElementById("plc-template").content;
const rowTemplate = document.getElementById("row-template").content;

/** A row: one tag. */
class Row {
  constructor(tag, position, open) {
    this.tag = tag;
    this.element = rowTemplate.firstElementChild.cloneNode(true);
    this.element.setAttribute("aria-rowindex", String(position));
    const find = selector => this.element.querySelector(selector);
    [this.note, this.number, this.mark, this.label, this.age, this.svg] =
      [".name .note", ".number", ".mark", ".label", ".age", "svg"].map(find);
    const button = find(".open");
    button.textContent = tag.tag;
    button.setAttribute("aria-haspopup", "dialog");
    button.addEventListener("click", () => open(this.tag));
    find(".unit").textContent = tag.unit ? format.plain(tag.unit) : "";
    this.element.title = [tag.at, tag.comment].filter(Boolean).map(format.plain).join("\n");
  }

  show(model, now) {
    const { tag } = this;
    this.element.dataset.state = tag.quality;
    this.mark.dataset.state = tag.quality;
    format.setText(this.label, tag.quality);
    format.setText(this.number, format.value(tag.value));
    if (typeof tag.value === "boolean") this.number.dataset.on = String(tag.value);
    else delete this.number.dataset.on;
    format.setText(this.note, format.plain(tag.why ?? tag.comment ?? tag.at));
    this.showAge(now);
    this.drawLine(model);
  }

  showAge(now) {
    format.setText(this.age, format.age(now - this.tag.since));
  }

  drawLine(model) {
    if (this.tag.drawn) draw(this.svg, model.line(this.tag), model.progress, this.tag.isDiscrete);
  }
}

/** A group of rows, which takes its space also while it has none. */
class Group {
  constructor(tags, first) {
    this.tags = tags;
    this.first = first;
    this.rows = [];
    this.element = document.createElement("div");
    this.element.className = "rows";
    this.element.setAttribute("role", "rowgroup");
    this.element.style.setProperty("--rows", String(tags.length));
  }

  fill(list) {
    if (this.rows.length > 0) return;
    const now = performance.now();
    this.rows = this.tags.map((tag, index) => new Row(tag, this.first + index + 2, list.open));
    for (const row of this.rows) {
      row.show(list.model, now);
      list.rows.set(row.tag.index, row);
    }
    this.element.replaceChildren(...this.rows.map(row => row.element));
    this.load(list);
  }

  empty(list) {
    // The focus must not get lost.
    if (this.element.contains(document.activeElement)) return;
    for (const row of this.rows) list.rows.delete(row.tag.index);
    this.rows = [];
    this.element.replaceChildren();
  }

  /** Loads the last values that the page has not seen. */
  async load(list) {
    const tags = list.model.unloaded(this.tags);
    if (tags.length === 0) return;
    try {
      await list.model.loadHistory(tags[0].plc, tags);
    } catch {
      // Without them lines begin now; the next snapshot tries again.
      return;
    }
    for (const row of this.rows) row.drawLine(list.model);
  }
}

/** A PLC. */
class Plc {
  constructor(name, list) {
    this.name = name;
    this.list = list;
    this.isOpen = false;
    this.tags = [];
    this.groups = [];
    this.element = plcTemplate.firstElementChild.cloneNode(true);
    const find = selector => this.element.querySelector(selector);
    [this.button, this.table, this.mark, this.state, this.link, this.counts, this.roundTrip] =
      [".fold", ".tags", ".mark", ".state", ".link", ".counts", ".round-trip"].map(find);
    this.bars = ["good", "stale", "bad"].map(grade => find(`.grades .${grade}`));
    find(".plc-name").textContent = name;
    this.table.id = `tags-${name}`;
    this.table.setAttribute("aria-label", `Tags of ${name}`);
    this.button.setAttribute("aria-controls", this.table.id);
    this.button.addEventListener("click", () => this.setOpen(!this.isOpen));
  }

  setOpen(isOpen) {
    this.isOpen = isOpen;
    this.layOut();
    this.list.showFolding();
  }

  /** Shows these of its tags. */
  setTags(tags, isSearch) {
    const isSame = tags.length === this.tags.length && tags.every((tag, index) => tag === this.tags[index]);
    const wasOpen = this.button.getAttribute("aria-expanded") === "true";
    this.tags = tags;
    this.isSearch = isSearch;
    if (!isSame || wasOpen !== this.isUnfolded) this.layOut();
  }

  get isUnfolded() {
    return this.isOpen || this.isSearch;
  }

  layOut() {
    const { list, tags } = this;
    for (const group of this.groups) {
      list.observer.unobserve(group.element);
      list.groups.delete(group.element);
      for (const row of group.rows) list.rows.delete(row.tag.index);
      group.element.remove();
    }
    this.groups = [];
    this.button.setAttribute("aria-expanded", String(this.isUnfolded));
    this.table.hidden = !this.isUnfolded;
    if (!this.isUnfolded) return;
    this.table.setAttribute("aria-rowcount", String(tags.length + 1));
    for (let first = 0; first < tags.length; first += GROUP) {
      const group = new Group(tags.slice(first, first + GROUP), first);
      this.groups.push(group);
      list.groups.set(group.element, group);
      list.observer.observe(group.element);
    }
    this.table.append(...this.groups.map(group => group.element));
  }

  showStatus(status) {
    if (!status) return;
    const { good, stale, bad } = status.tags;
    const all = good + stale + bad;
    const state = status.online ? (stale + bad > 0 ? "stale" : "good") : status.round_trip_ms === null ? "idle" : "bad";
    this.mark.dataset.state = state;
    format.setText(this.state, status.online ? "" : format.plain(status.why ?? "offline"));
    const place = [status.bus, status.link, `station ${status.station}`].filter(Boolean).join(" · ");
    format.setText(this.link, format.plain(place));
    [good, stale, bad].forEach((count, index) => {
      this.bars[index].style.width = all > 0 ? `${(count / all) * 100}%` : "0";
    });
    const notGood = [[stale, "stale"], [bad, "bad"]].filter(([count]) => count > 0).map(([count, grade]) => `${count} ${grade}`);
    format.setText(this.counts, notGood.length > 0 ? notGood.join(", ") : format.counted(all, "tag"));
    format.setText(this.roundTrip, format.milliseconds(status.online ? status.round_trip_ms : null));
  }
}

export class PlcList {
  /** `open`: shows a tag in detail. */
  constructor(model, open) {
    this.model = model;
    this.open = open;
    this.plcs = new Map();
    /** The groups by element, and the rows that exist by the place of their tag. */
    this.groups = new Map();
    this.rows = new Map();
    this.element = document.getElementById("list");
    this.filter = document.getElementById("filter");
    this.notGood = document.getElementById("not-good");
    this.matches = document.getElementById("matches");
    this.expand = document.getElementById("expand");
    this.observer = new IntersectionObserver(entries => this.#move(entries), { rootMargin: MARGIN });
    this.filter.addEventListener("input", () => this.#search());
    this.notGood.addEventListener("change", () => this.#search());
    this.expand.addEventListener("click", () => this.#expandAll());
  }

  #move(entries) {
    for (const { target, isIntersecting } of entries) {
      const group = this.groups.get(target);
      if (isIntersecting) group?.fill(this);
      else group?.empty(this);
    }
  }

  /** Takes over the PLCs and tags of a snapshot. */
  takeSnapshot() {
    const isFirst = this.plcs.size === 0;
    const earlier = this.plcs;
    this.plcs = new Map();
    let unfolded = 0;
    for (const { name, tags } of this.model.plcs) {
      const plc = earlier.get(name) ?? new Plc(name, this);
      this.plcs.set(name, plc);
      if (isFirst && (unfolded === 0 || unfolded + tags.length <= UNFOLDED_TAGS)) plc.isOpen = true;
      unfolded += tags.length;
    }
    const focused = document.activeElement;
    for (const [name, plc] of earlier) if (!this.plcs.has(name)) plc.setTags([], false);
    const elements = [...this.plcs.values()].map(plc => plc.element);
    if (elements.length !== this.element.childElementCount || elements.some((element, index) => element !== this.element.children[index])) {
      this.element.replaceChildren(...elements);
      if (this.element.contains(focused)) focused.focus();
    }
    this.#search();
    const now = performance.now();
    for (const row of this.rows.values()) row.show(this.model, now);
    for (const group of this.groups.values()) if (group.rows.length > 0) group.load(this);
    this.showStatus();
    this.showFolding();
  }

  /** Shows changed tags. `isSlot`: all lines have moved. */
  show(changed, isSlot, now) {
    for (const tag of changed) this.rows.get(tag.index)?.show(this.model, now);
    if (isSlot) for (const row of this.rows.values()) row.drawLine(this.model);
    if (this.notGood.checked && changed.some(tag => tag.quality !== tag.shownQuality)) this.#search();
  }

  showStatus() {
    for (const { name, status } of this.model.plcs) this.plcs.get(name)?.showStatus(status);
  }

  showAges(now) {
    for (const row of this.rows.values()) row.showAge(now);
  }

  /** Shows the tags that match the filter. */
  #search() {
    const words = this.filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    const isSearch = words.length > 0 || this.notGood.checked;
    let found = 0;
    for (const { name, tags } of this.model.plcs) {
      const matching = isSearch ? tags.filter(tag => this.#matches(tag, words)) : tags;
      const plc = this.plcs.get(name);
      plc.element.hidden = isSearch && matching.length === 0;
      plc.setTags(matching, isSearch && matching.length > 0);
      found += matching.length;
    }
    for (const tag of this.model.tags) tag.shownQuality = tag.quality;
    const all = format.counted(this.model.tags.length, "tag");
    format.setText(this.matches, isSearch ? `${found === 0 ? "None" : format.count(found)} of ${all}` : "");
    this.showFolding();
  }

  #matches(tag, words) {
    return (!this.notGood.checked || tag.quality !== "good") && words.every(word => tag.text.includes(word));
  }

  #expandAll() {
    const plcs = [...this.plcs.values()];
    const isOpen = plcs.some(plc => !plc.isOpen);
    for (const plc of plcs) {
      plc.isOpen = isOpen;
      plc.layOut();
    }
    this.showFolding();
  }

  showFolding() {
    const isAllOpen = [...this.plcs.values()].every(plc => plc.isOpen);
    format.setText(this.expand, isAllOpen ? "Collapse all" : "Expand all");
  }
}
