// Lines of last values, as paths of SVG.

const MARGIN = 2;

/** Smallest and largest of the values; `null` if there are none. */
export function range(values) {
  let min = Infinity;
  let max = -Infinity;
  for (const value of values) {
    if (value < min) min = value;
    if (value > max) max = value;
  }
  return min <= max ? { min, max } : null;
}

/**
 * Draws values into the two paths of an SVG element. NaN leaves a gap.
 *
 * The last value is the current one; `progress` is its distance from the one before, which are 1 apart otherwise.
 */
export function draw(svg, values, progress, isDiscrete) {
  const { width, height } = svg.viewBox.baseVal;
  const limits = isDiscrete ? { min: 0, max: 1 } : range(values);
  const [area, line] = svg.children;
  if (!limits) {
    area.setAttribute("d", "");
    line.setAttribute("d", "");
    svg.dataset.points = "0";
    return;
  }
  const span = limits.max - limits.min;
  const last = values.length - 1;
  const length = last - 1 + progress;
  const x = index => round(((index === last ? length : index) / length) * width);
  const y = value => round(span > 0 ? height - MARGIN - ((value - limits.min) / span) * (height - 2 * MARGIN) : height / 2);
  let path = "";
  let filled = "";
  let points = 0;
  let begin = -1;
  for (let index = 0; index <= values.length; index++) {
    const value = values[index];
    if (index < values.length && !Number.isNaN(value)) {
      points += 1;
      if (begin < 0) {
        begin = index;
        const start = `${x(index)} ${y(value)}`;
        path += `M${start}h0.01`;
        filled += `M${x(index)} ${height}L${start}`;
        continue;
      }
      const step = isDiscrete ? `H${x(index)}V${y(value)}` : `L${x(index)} ${y(value)}`;
      path += step;
      filled += step;
    } else if (begin >= 0) {
      filled += `V${height}Z`;
      begin = -1;
    }
  }
  line.setAttribute("d", path);
  area.setAttribute("d", filled);
  svg.dataset.points = String(points);
}

function round(number) {
  return Math.round(number * 10) / 10;
}
