// The event stream of the bridge: connects again by itself, and tells when the connection is lost.

/** The bridge sends twice a second; longer silence means that the connection is lost. */
const SILENCE_MS = 4000;
const FIRST_DELAY_MS = 500;
const LONGEST_DELAY_MS = 8000;
/** A page that is hidden for this long gives its connection to others. */
const HIDDEN_MS = 60000;

export class Stream {
  #url;
  #on;
  #source = null;
  #heard = 0;
  #delay = FIRST_DELAY_MS;
  #retry = 0;
  #isLost = false;
  #hidden = 0;

  /** `on`: the functions `snapshot`, `changes`, `live` and `lost`. */
  constructor(url, on) {
    this.#url = url;
    this.#on = on;
    setInterval(() => this.#watch(), 500);
    document.addEventListener("visibilitychange", () => this.#changeVisibility());
    addEventListener("online", () => this.#open());
    // The browser keeps a page that was left, but not its connection.
    addEventListener("pageshow", event => event.persisted && this.#open());
    this.#open();
  }

  #open() {
    this.#close();
    this.#heard = performance.now();
    const source = new EventSource(this.#url);
    this.#source = source;
    const take = (name, act) => source.addEventListener(name, event => {
      if (source !== this.#source) return;
      this.#heard = performance.now();
      act(JSON.parse(event.data), this.#heard);
    });
    take("snapshot", (snapshot, now) => {
      this.#delay = FIRST_DELAY_MS;
      this.#isLost = false;
      this.#on.snapshot(snapshot, now);
      this.#on.live();
    });
    take("changes", (changes, now) => this.#on.changes(changes, now));
    source.onerror = () => source === this.#source && this.#lose();
  }

  #close() {
    clearTimeout(this.#retry);
    this.#source?.close();
    this.#source = null;
  }

  #lose() {
    this.#close();
    if (!this.#isLost) {
      this.#isLost = true;
      this.#on.lost(this.#heard);
    }
    if (document.hidden && this.#hidden < 0) return;
    const jitter = 0.5 + Math.random() / 2;
    this.#retry = setTimeout(() => this.#open(), this.#delay * jitter);
    this.#delay = Math.min(this.#delay * 2, LONGEST_DELAY_MS);
  }

  #watch() {
    if (this.#source && performance.now() - this.#heard > SILENCE_MS) this.#lose();
  }

  #changeVisibility() {
    clearTimeout(this.#hidden);
    if (document.hidden) {
      this.#hidden = setTimeout(() => {
        this.#hidden = -1;
        this.#lose();
      }, HIDDEN_MS);
    } else {
      const wasClosed = this.#hidden === -1;
      this.#hidden = 0;
      if (wasClosed || !this.#source) {
        this.#delay = FIRST_DELAY_MS;
        this.#open();
      }
    }
  }
}
