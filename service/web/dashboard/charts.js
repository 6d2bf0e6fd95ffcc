// Curves over one axis, drawn by uPlot in the page's colours.
const AXIS_REM = 1.7; // below the lowest chart
let loaded = null;

export function library() {
  loaded ??= new Promise((done) => {
    const script = document.createElement("script");
    script.src = "/dashboard/uplot/uPlot.iife.min.js";
    script.onload = () => done(window.uPlot);
    document.head.append(script);
  });
  return loaded;
}

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

// Where a line is interrupted: between neighbouring values that are further apart than `most` of the axis.
const gapsOver = (most) => (plot, line, first, last) => {
  const [x, values] = [plot.data[0], plot.data[line]], known = [], at = (i) => plot.valToPos(x[i], "x", true);
  for (let i = first; i <= last; i += 1) if (values[i] != null) known.push(i);
  return known.slice(1).flatMap((i, k) => (x[i] - x[known[k]] > most ? [[at(known[k]), at(i)]] : []));
};

// One chart: `lines` are {colour, values, points, dash}, which the title names; `x` what they stand over, numbers or, with
// `gap`, seconds; of charts one above the other that share it, only the lowest writes it (`over`: another one is below).
// Charts of one `key` share a cursor.
export async function chart(place, { title, unit, x, lines, key, height, range, onCursor, gap, over, axis = "", scales = {} }) {
  const uPlot = await library();
  const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
  const quiet = colour("quiet"), grid = { stroke: colour("line"), width: 1 }, font = `${0.85 * rem}px system-ui, sans-serif`;
  const heading = document.createElement("p");
  heading.className = "chart-title";
  heading.textContent = title;
  place.append(heading);
  const size = () => ({ width: Math.max(200, place.clientWidth), height: height + (over ? 0 : AXIS_REM * rem) });
  const options = {
    ...size(), legend: { show: false }, padding: [0.6 * rem, 0.8 * rem, over ? 0.6 * rem : 0, 0],
    cursor: { y: false, sync: { key }, drag: { x: false, y: false }, points: { show: false } },
    scales: { x: { time: false, ...scales }, y: range ? { range } : {} },
    axes: [{ stroke: quiet, grid, font, size: over ? 0 : AXIS_REM * rem, ticks: { show: !over }, ...(gap ? {} : { incrs: [1, 2, 5, 10, 20, 50, 100] }), values: (_, ticks) => ticks.map((tick) => (over || tick === null ? "" : `${tick}${axis}`)) }, { stroke: quiet, grid, font, size: 3.8 * rem, values: (_, ticks) => ticks.map((tick) => `${tick}${unit}`) }],
    series: [{}, ...lines.map((line) => ({ stroke: colour(line.colour), width: line.points ? 0 : 2, dash: line.dash, ...(gap ? { gaps: gapsOver(gap) } : { spanGaps: true }), points: { show: Boolean(line.points), size: 6, fill: colour(line.colour) } }))],
    hooks: onCursor ? { setCursor: [(plot) => { if (plot.cursor.left >= 0 && plot.cursor.event) onCursor(plot.posToVal(plot.cursor.left, "x")); }] } : {},
  };
  const made = new uPlot(options, [x, ...lines.map((line) => line.values)], place);
  new ResizeObserver(() => made.setSize(size())).observe(place);
  made.root.setAttribute("role", "img");
  made.root.setAttribute("aria-label", title);
  return made;
}
