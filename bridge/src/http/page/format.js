// Texts of values, times and sizes.

/** Characters that could hide or reorder text: control characters and marks of direction. */
const HIDDEN = /[\u0000-\u001f\u007f-\u009f\u200e\u200f\u202a-\u202e\u2066-\u2069]/g;
/** The values of a tag with several that are shown. */
const SHOWN = 6;

/** A text from a configuration or a PLC, without characters that could hide or reorder it. */
export function plain(text) {
  return text.replace(HIDDEN, "\ufffd");
}

/** The value of a tag. */
export function value(value) {
  if (value === null || value === undefined) return "–";
  if (typeof value === "boolean") return value ? "on" : "off";
  if (typeof value === "number") return number(value);
  if (Array.isArray(value)) {
    const shown = value.slice(0, SHOWN).map(single => valueOfList(single)).join(", ");
    return value.length > SHOWN ? `${shown}, … (${value.length})` : shown;
  }
  return plain(String(value));
}

function valueOfList(single) {
  return typeof single === "boolean" ? (single ? "1" : "0") : value(single);
}

/** A number with at most seven digits, unless it is an integer. */
export function number(value) {
  return String(Number.isInteger(value) ? value : Number(value.toPrecision(7)));
}

/** A number for people, with three digits. */
export function short(value) {
  if (value === null || value === undefined) return "–";
  return value >= 100 ? count(Math.round(value)) : String(Number(value.toPrecision(3)));
}

/** A count with separators. */
export function count(value) {
  return value.toLocaleString("en");
}

/** A time in milliseconds, as an age. */
export function age(ms) {
  const seconds = Math.max(0, ms) / 1000;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.floor(seconds)} s`;
  if (seconds < 7200) return `${Math.floor(seconds / 60)} min`;
  if (seconds < 172800) return `${Math.floor(seconds / 3600)} h`;
  return `${Math.floor(seconds / 86400)} days`;
}

/** A round trip in milliseconds. */
export function milliseconds(ms) {
  return ms === null || ms === undefined ? "–" : `${ms < 10 ? ms.toFixed(1) : Math.round(ms)} ms`;
}

/** A size in bytes. */
export function bytes(size) {
  for (const unit of ["B", "KiB", "MiB"]) {
    if (size < 1024) return `${short(size)} ${unit}`;
    size /= 1024;
  }
  return `${short(size)} GiB`;
}

/** A part of one, in percent. */
export function percent(part) {
  if (part === null || part === undefined) return "–";
  return part > 0 && part < 0.01 ? "<1 %" : `${Math.round(part * 100)} %`;
}

/** A count with its noun: "1 tag", "2 tags". */
export function counted(number, noun) {
  return `${count(number)} ${noun}${number === 1 ? "" : "s"}`;
}

/** Sets a text only if it is another one, so that the browser has nothing to draw otherwise. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
