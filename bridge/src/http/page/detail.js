// A tag in detail: its last values, and all that the configuration says.

import * as format from "./format.js";
import { draw, range } from "./spark.js";

const byId = id => document.getElementById(id);

export class Detail {
  constructor(model) {
    this.model = model;
    this.key = null;
    this.dialog = byId("detail");
    this.facts = byId("detail-facts");
    this.svg = this.dialog.querySelector("svg");
    this.limits = ["max", "min"].map(limit => this.dialog.querySelector(`.${limit}`));
    byId("detail-close").addEventListener("click", () => this.dialog.close());
    // A click beside the dialog is one on itself, and not on its content.
    this.dialog.addEventListener("click", event => event.target === this.dialog && this.dialog.close());
    this.dialog.addEventListener("close", () => (this.key = null));
  }

  open(tag) {
    this.key = tag.key;
    this.show();
    this.dialog.showModal();
  }

  show() {
    if (this.key === null) return;
    const tag = this.model.tags.find(tag => tag.key === this.key);
    if (!tag) {
      // A reload has removed it.
      this.dialog.close();
      return;
    }
    format.setText(byId("detail-plc"), tag.plc);
    format.setText(byId("detail-title"), tag.tag);
    const value = Array.isArray(tag.value) ? tag.value.map(format.value).join(", ") : format.value(tag.value);
    format.setText(byId("detail-value"), value);
    format.setText(byId("detail-unit"), tag.unit ? format.plain(tag.unit) : "");
    byId("detail-value").parentElement.dataset.state = tag.quality;
    const line = tag.drawn ? this.model.line(tag) : [];
    this.#showChart(tag, line);
    this.#showFacts(tag, line);
  }

  #showChart(tag, line) {
    byId("detail-chart").hidden = !tag.drawn;
    if (!tag.drawn) return;
    const { isDiscrete } = tag;
    draw(this.svg, line, this.model.progress, isDiscrete);
    const limits = range(line);
    const texts = isDiscrete ? ["on", "off"] : limits ? [format.number(limits.max), format.number(limits.min)] : ["", ""];
    // A constant has one limit.
    if (texts[0] === texts[1]) texts[1] = "";
    this.limits.forEach((element, index) => format.setText(element, texts[index]));
    const seconds = ((line.length - 1) * this.model.slotMs) / 1000;
    format.setText(byId("detail-from"), seconds < 120 ? `${seconds} seconds ago` : `${Math.round(seconds / 60)} minutes ago`);
  }

  #showFacts(tag, line) {
    const facts = [
      ["Quality", tag.why ? `${tag.quality}: ${tag.why}` : tag.quality],
      [tag.quality === "bad" ? "Bad for" : "Age", format.age(performance.now() - tag.since)],
      ["Mean", typeof tag.value === "number" ? mean(line) : null],
      ["Address", tag.at],
      ["Scan class", tag.class ?? "default"],
      ["Group", tag.group],
      ["Comment", tag.comment],
      ["Writable", writable(tag.write)],
    ].filter(([, text]) => text);
    if (this.facts.childElementCount !== 2 * facts.length) {
      this.facts.replaceChildren(...facts.flatMap(() => [document.createElement("dt"), document.createElement("dd")]));
    }
    facts.forEach(([name, text], index) => {
      format.setText(this.facts.children[2 * index], name);
      format.setText(this.facts.children[2 * index + 1], format.plain(text));
    });
  }
}

function mean(line) {
  const values = line.filter(value => !Number.isNaN(value));
  return values.length > 0 ? String(Number((values.reduce((sum, value) => sum + value, 0) / values.length).toPrecision(4))) : null;
}

function writable(rule) {
  if (!rule) return null;
  const limits = [["from", rule.min], ["to", rule.max]].filter(([, limit]) => limit !== null);
  const range = limits.map(([word, limit]) => `${word} ${limit}`).join(" ");
  return [rule.pulse_ms === null ? "yes" : `pulse of ${rule.pulse_ms} ms`, range].filter(Boolean).join(", ");
}
