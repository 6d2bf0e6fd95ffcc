// Curves over one axis, drawn by uPlot in the page's colours.
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

// One chart: `lines` are {label, colour, values, points}; `x` what they stand over; charts of one `key` share a cursor.
export async function chart(place, { title, unit, x, lines, key, height, range, onCursor, axis = "", scales = {} }) {
  const uPlot = await library();
  const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
  const quiet = colour("quiet"), grid = { stroke: colour("line"), width: 1 }, font = `${0.85 * rem}px system-ui, sans-serif`;
  const heading = document.createElement("p");
  heading.className = "chart-title";
  heading.textContent = title;
  place.append(heading);
  const options = {
    width: Math.max(200, place.clientWidth), height, legend: { show: lines.length > 1, live: false },
    cursor: { sync: { key }, drag: { x: false, y: false }, points: { show: false } },
    scales: { x: { time: false, ...scales }, y: range ? { range } : {} },
    axes: [{ stroke: quiet, grid, font, size: 1.7 * rem, values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : `${tick}${axis}`)) }, { stroke: quiet, grid, font, size: 3.4 * rem, values: (_, ticks) => ticks.map((tick) => `${tick}${unit}`) }],
    series: [{}, ...lines.map((line) => ({ label: line.label, stroke: colour(line.colour), width: line.points ? 0 : 2, spanGaps: true, points: { show: Boolean(line.points), size: 6, fill: colour(line.colour) } }))],
    hooks: onCursor ? { setCursor: [(plot) => { if (plot.cursor.left >= 0 && plot.cursor.event) onCursor(plot.posToVal(plot.cursor.left, "x")); }] } : {},
  };
  const made = new uPlot(options, [x, ...lines.map((line) => line.values)], place);
  made.root.setAttribute("role", "img");
  made.root.setAttribute("aria-label", title);
  return made;
}
