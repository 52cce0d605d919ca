// What the page knows: the tags with their values and last values, and the figures of the bridge.
//
// Invariants:
// - a tag is known by its place in the list of all tags, until the next snapshot;
// - ages are of the server's clock: `since` is when the value was read, on the clock of this page;
// - a bad tag has no value.

/** The last values of a tag: a ring by slot. */
class Ring {
  constructor(slots) {
    this.values = new Float32Array(slots).fill(NaN);
    /** The newest slot that the server has filled in. */
    this.loaded = 0;
    this.isLoading = false;
  }

  get(slot) {
    return this.values[slot % this.values.length];
  }

  set(slot, value) {
    this.values[slot % this.values.length] = value;
  }
}

/** A value as a number for a line; NaN if there is none. */
function numberOf(tag) {
  if (tag.quality !== "good") return NaN;
  if (typeof tag.value === "boolean") return tag.value ? 1 : 0;
  return typeof tag.value === "number" ? tag.value : NaN;
}

export class Model {
  constructor() {
    this.plcs = [];
    this.tags = [];
    this.status = null;
    this.slot = 0;
    this.slots = 150;
    this.slotMs = 2000;
    /** When the newest slot came. */
    this.slotAt = 0;
  }

  /** The part of the next slot that has passed: 0 to 1. */
  get progress() {
    return Math.min(1, (performance.now() - this.slotAt) / this.slotMs);
  }

  /** Takes a snapshot: other PLCs and tags, or a new beginning after a lost connection. */
  takeSnapshot(snapshot, now) {
    const earlier = new Map(this.tags.map(tag => [tag.key, tag]));
    // After a restart of the bridge its slots begin anew.
    const goesOn = snapshot.slot >= this.slot && snapshot.slots === this.slots;
    this.slots = snapshot.slots;
    this.slotMs = snapshot.slot_ms;
    this.tags = [];
    this.plcs = snapshot.plcs.map(({ plc, tags }) => {
      const first = this.tags.length;
      for (const tag of tags) {
        const key = `${plc}/${tag.tag}`;
        const index = this.tags.length;
        const settings = JSON.stringify(tag);
        const known = earlier.get(key);
        const ring = goesOn ? known?.ring : undefined;
        if (known?.index === index && known.settings === settings) {
          // The same object: its row stays, and with it the focus.
          known.ring = ring;
          this.tags.push(known);
        } else {
          const words = [plc, tag.tag, tag.at, tag.unit, tag.comment, tag.group, tag.class];
          const text = words.filter(Boolean).join("\n").toLowerCase();
          this.tags.push({ ...tag, plc, key, settings, text, index, ring });
        }
      }
      return { name: plc, tags: this.tags.slice(first), status: null };
    });
    snapshot.values.forEach((value, index) => this.#set(index, value, now));
    for (const tag of this.tags) {
      if (!tag.ring) continue;
      // Slots that went by unseen are asked for again.
      for (let slot = this.slot + 1; slot <= snapshot.slot && slot <= this.slot + this.slots; slot++) tag.ring.set(slot, NaN);
      tag.ring.loaded = 0;
    }
    this.slot = snapshot.slot;
    this.slotAt = now;
    this.#takeStatus(snapshot.status);
  }

  /** Takes changes, and returns the tags that have changed. */
  takeChanges(changes, now) {
    const changed = [];
    for (const [index, value] of changes.values) {
      this.#set(index, value, now);
      changed.push(this.tags[index]);
    }
    for (const [age, first, last] of changes.read) {
      for (let index = first; index <= last; index++) this.tags[index].since = now - age;
    }
    while (this.slot < changes.slot) {
      this.slot += 1;
      this.slotAt = now;
      for (const tag of this.tags) tag.ring?.set(this.slot, numberOf(tag));
    }
    if (changes.status) this.#takeStatus(changes.status);
    return changed;
  }

  #set(index, [value, quality, age, why], now) {
    const tag = this.tags[index];
    tag.value = value;
    // A bad tag has no value that tells.
    if (value !== null) tag.isDiscrete = typeof value === "boolean";
    tag.quality = quality;
    tag.since = now - age;
    tag.why = why;
  }

  #takeStatus(status) {
    this.status = status;
    const byName = new Map(status.plcs.map(plc => [plc.plc, plc]));
    for (const plc of this.plcs) plc.status = byName.get(plc.name) ?? plc.status;
  }

  /** The tags of a list whose last values have to be loaded. */
  unloaded(tags) {
    return tags.filter(tag => tag.drawn && !(tag.ring?.loaded > 0) && !tag.ring?.isLoading);
  }

  /** Loads the last values of tags of one PLC. */
  async loadHistory(plc, tags) {
    for (const tag of tags) {
      tag.ring ??= new Ring(this.slots);
      tag.ring.isLoading = true;
    }
    try {
      const query = new URLSearchParams({ plc, tags: tags.map(tag => tag.tag).join(",") });
      const response = await fetch(`api/history?${query}`);
      if (!response.ok) throw new Error(response.statusText);
      const history = await response.json();
      for (const tag of tags) this.#fill(tag.ring, history.slot, history.tags[tag.tag] ?? []);
    } finally {
      for (const tag of tags) tag.ring.isLoading = false;
    }
  }

  #fill(ring, newest, values) {
    values.forEach((value, index) => {
      const slot = newest - values.length + 1 + index;
      if (slot > this.slot - this.slots && slot > 0 && value !== null) ring.set(slot, value);
    });
    ring.loaded = Math.max(newest, 1);
  }

  /** The last values of a tag, the oldest first, and its current one. */
  line(tag) {
    const length = Math.min(Math.max(this.slot, MIN_SLOTS), this.slots);
    const values = new Array(length + 1);
    for (let index = 0; index < length; index++) {
      const slot = this.slot - length + 1 + index;
      values[index] = slot > 0 && tag.ring ? tag.ring.get(slot) : NaN;
    }
    values[length] = numberOf(tag);
    return values;
  }
}

/** The slots of a line, at least: shortly after the start a line does not fill its width. */
const MIN_SLOTS = 15;
