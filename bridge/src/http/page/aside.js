// The overview, and the lists of links, outputs and the buffer.

import * as format from "./format.js";

const itemTemplate = document.getElementById("item-template").content;

/** A list whose items stay the same elements as long as their names do. */
class ItemList {
  constructor(id, emptyText) {
    this.element = document.getElementById(id);
    this.emptyText = emptyText;
    this.items = new Map();
  }

  /** `items`: of each, its name, state, and texts. */
  show(items) {
    const names = items.map(item => item.name);
    if (names.join("\n") !== [...this.items.keys()].join("\n") || this.element.childElementCount === 0) {
      this.items = new Map(names.map(name => [name, this.items.get(name) ?? itemTemplate.firstElementChild.cloneNode(true)]));
      this.element.replaceChildren(...this.items.values());
      if (items.length === 0) {
        const empty = document.createElement("li");
        empty.className = "empty";
        empty.textContent = this.emptyText;
        this.element.append(empty);
      }
    }
    for (const item of items) showItem(this.items.get(item.name), item);
  }
}

function showItem(element, { name, mark, state, part, partState, facts, why }) {
  const find = selector => element.querySelector(selector);
  find(".mark").dataset.state = mark;
  format.setText(find(".item-name"), format.plain(name));
  format.setText(find(".state"), state);
  const meter = find(".meter");
  meter.hidden = part === null || part === undefined;
  meter.dataset.state = partState ?? "good";
  meter.firstElementChild.style.width = `${Math.min(1, part ?? 0) * 100}%`;
  format.setText(find(".facts-line"), facts.filter(Boolean).join(" · "));
  format.setText(find(".why"), why ? format.plain(why) : "");
}

function batches(number) {
  return `${format.count(number)} ${number === 1 ? "batch" : "batches"}`;
}

/** The state of a part of what is there: from 0.7 on it needs a look, from 0.9 on it is bad. */
function grade(part) {
  return part >= 0.9 ? "bad" : part >= 0.7 ? "stale" : "good";
}

const MARKS = { up: "good", connecting: "stale", waiting: "stale", down: "bad", idle: "idle", closed: "idle" };

function linkItem(link, plcs) {
  const rate = link.requests_per_second;
  const names = plcs.filter(plc => plc.link === link.link).map(plc => plc.plc);
  return {
    name: link.link,
    mark: MARKS[link.state] ?? "idle",
    state: link.state,
    part: link.load,
    partState: grade(link.load ?? 0),
    facts: [
      `load ${format.percent(link.load)}`,
      rate === null ? null : `${format.short(rate)} requests/s`,
      names.length > 3 ? format.counted(names.length, "PLC") : names.join(", "),
      link.disconnects > 0 && format.counted(link.disconnects, "lost connection"),
      link.checksum_errors > 0 && format.counted(link.checksum_errors, "checksum error"),
    ],
    why: link.why,
  };
}

function outputItem(output) {
  const rate = output.samples_per_second;
  return {
    name: output.output,
    mark: output.connected ? "good" : "bad",
    state: output.connected ? "connected" : "not connected",
    part: null,
    facts: [
      rate === null ? null : `${format.short(rate)} samples/s`,
      `lag ${batches(output.lag)}`,
      output.dropped > 0 && `${format.count(output.dropped)} dropped`,
      output.skipped > 0 && `${format.count(output.skipped)} given up`,
      output.no_subscribers > 0 && `${format.count(output.no_subscribers)} without a subscriber`,
      output.reconnects > 0 && format.counted(output.reconnects, "reconnect"),
    ],
    why: output.failure,
  };
}

const FLEET_MARKS = { active: "good", draining: "stale", joining: "stale", connecting: "bad", failed: "bad", left: "idle" };

/** Items of the fleet: all of it first, then its members. */
function fleetItems({ fleet, member, state, failure, lease_ms: lease, open_for_ms: openFor, links, members, warnings }) {
  // A renewal comes three times in a lease, and this status can be half a second old.
  const isSilent = other => other.silent_for_ms > lease * 0.6 + 500;
  const whole = {
    name: fleet,
    mark: FLEET_MARKS[state] ?? "idle",
    state: state === "active" ? "" : state,
    part: null,
    facts: [
      `${format.count(links.own)} of ${format.counted(links.all, "link")} here`,
      links.without_owner > 0 && `${format.count(links.without_owner)} without owner`,
      openFor === null && "sends nothing to its PLCs",
    ],
    why: failure ?? warnings.join("; "),
  };
  const each = members.map(other => ({
    name: other.member,
    mark: other.draining || isSilent(other) ? "stale" : "good",
    state: [other.member === member && "this bridge", other.draining && "drained"].filter(Boolean).join(", "),
    part: links.all > 0 ? other.links / links.all : 0,
    partState: "good",
    facts: [
      format.counted(other.links, "link"),
      other.weight !== 1 && `weight ${other.weight}`,
      isSilent(other) && `silent for ${format.age(other.silent_for_ms)}`,
      `version ${other.version}`,
    ],
    why: null,
  }));
  return [whole, ...each];
}

export class Aside {
  constructor() {
    this.fleet = new ItemList("fleet", "");
    this.links = new ItemList("links", "No link yet");
    this.outputs = new ItemList("outputs", "No output is configured");
    [this.buffer, this.commands] = ["buffer", "commands"].map(id => {
      const panel = document.getElementById(id);
      panel.append(...itemTemplate.firstElementChild.cloneNode(true).childNodes);
      panel.classList.add("item");
      return panel;
    });
    this.cards = new Map([...document.querySelectorAll(".card")].map(card => [card.dataset.figure, card]));
    this.title = document.getElementById("bridge");
    this.uptime = document.getElementById("uptime");
    this.version = document.getElementById("version");
  }

  show(status) {
    this.links.show(status.links.map(link => linkItem(link, status.plcs)));
    this.outputs.show(status.outputs.map(outputItem));
    this.#showBuffer(status.buffer);
    this.#showCommands(status.commands);
    document.getElementById("fleet-section").hidden = status.fleet === null;
    if (status.fleet !== null) this.fleet.show(fleetItems(status.fleet));
    this.#showOverview(status);
    format.setText(this.title, status.id);
    format.setText(this.uptime, `Running for ${format.age(status.uptime_seconds * 1000).replace(".0", "")}`);
    format.setText(this.version, `fatek-bridge ${status.version}`);
  }

  #showBuffer(buffer) {
    const memory = `${format.bytes(buffer.memory_bytes)} of ${format.bytes(buffer.memory_limit_bytes)} in memory`;
    const hasDisk = buffer.disk_limit_bytes !== null;
    showItem(this.buffer, {
      name: batches(buffer.batches),
      mark: buffer.failure ? "bad" : grade(buffer.fill),
      state: `${format.percent(buffer.fill)} full`,
      part: buffer.fill,
      partState: grade(buffer.fill),
      facts: [
        buffer.oldest_age_seconds === null ? null : `oldest ${format.age(buffer.oldest_age_seconds * 1000)}`,
        memory,
        hasDisk ? `${format.bytes(buffer.disk_bytes)} of ${format.bytes(buffer.disk_limit_bytes)} on disk` : "no disk",
      ],
      why: buffer.failure,
    });
  }

  #showCommands(commands) {
    document.getElementById("commands-section").hidden = commands === null;
    if (commands === null) return;
    const needsLook = commands.unknown > 0 || commands.open_pulses > 0;
    showItem(this.commands, {
      name: `${format.count(commands.ok)} executed`,
      mark: needsLook ? "stale" : "good",
      state: commands.waiting > 0 ? `${format.count(commands.waiting)} waiting` : "",
      part: null,
      facts: [
        `${format.count(commands.refused)} refused`,
        `${format.count(commands.unknown)} unknown`,
        commands.repeated > 0 && `${format.count(commands.repeated)} repeated`,
        commands.open_pulses > 0 && format.counted(commands.open_pulses, "open pulse"),
      ],
      why: null,
    });
  }

  #showOverview({ plcs, tags, poller, buffer, outputs }) {
    const online = plcs.filter(plc => plc.online).length;
    const all = tags.good + tags.stale + tags.bad;
    const connected = outputs.filter(output => output.connected).length;
    this.#card("plcs", format.count(online), `of ${format.count(plcs.length)}`, online < plcs.length ? "bad" : "good");
    this.#card("tags", format.count(tags.good), `of ${format.count(all)}`, tags.good < all ? "stale" : "good");
    const missed = poller.missed > 0 ? `${format.count(poller.missed)} missed` : "";
    this.#card("samples", format.short(poller.samples_per_second), missed, missed ? "stale" : "good");
    this.#card("buffer", format.percent(buffer.fill), batches(buffer.batches), buffer.failure ? "bad" : grade(buffer.fill));
    const isAllUp = connected === outputs.length;
    if (outputs.length === 0) this.#card("outputs", "–", "none", "good");
    else this.#card("outputs", format.count(connected), `of ${format.count(outputs.length)}`, isAllUp ? "good" : "bad");
  }

  #card(figure, number, rest, state) {
    const card = this.cards.get(figure);
    card.dataset.state = state;
    format.setText(card.querySelector("b"), number);
    format.setText(card.querySelector("span"), rest);
  }
}
