// The object and the gap, to scale: from above with its error and the next move, and from the side with its depth.
const NS = "http://www.w3.org/2000/svg";
const BESIDE = 30; // mm of the blocks that are shown from above
const ASIDE = 14; // and from the side: what is off by 15 mm is still in the picture

function shape(kind, attributes, text) {
  const made = document.createElementNS(NS, kind);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text) made.textContent = text;
  return made;
}

const at = ([x, theta]) => `translate(${x} 0) rotate(${-theta})`; // y points down in a drawing, so a positive turn is negative

// Sizes in mm: the object is drawn 2 mm clear on either side, and as long as the fingers are apart.
function sizes(running) {
  const gap = running?.gap_width_mm ?? 56;
  return { gap, wide: Math.max(4, gap - 4), long: Math.min(80, Math.max(12, running?.width_mm ?? 0.7 * gap)) };
}

export function drawAbove(svg, running) {
  const { gap, wide, long } = sizes(running);
  const box = (css, pose) => shape("rect", { class: css, x: -wide / 2, y: -long / 2, width: wide, height: long, rx: 2.5, transform: at(pose) });
  const pose = running?.pose ?? [0, 0], ghosts = running?.ghosts ?? [];
  const room = gap / 2 + BESIDE;
  svg.setAttribute("viewBox", `${-room} -54 ${2 * room} 108`);
  const parts = [-1, 1].map((side) => shape("rect", { class: "block", x: side < 0 ? -room : gap / 2, y: -45, width: room - gap / 2, height: 90 }));
  parts.push(shape("path", { class: "gap", d: `M${-gap / 2} -45V45M${gap / 2} -45V45` }));
  if (running) {
    parts.push(...ghosts.map((ghost) => box("ghost", ghost)), box(running.pose ? "object" : "object unknown", pose));
    const pads = shape("g", { transform: at(pose) });
    for (const y of [-long / 2 - 7, long / 2 + 1]) pads.append(shape("rect", { class: "pad", x: -11, y, width: 22, height: 6, rx: 1.5 }));
    parts.push(pads);
    if (running.target) parts.push(box("target", running.target), ...arrow(pose[0], running.target[0]));
  }
  parts.push(shape("text", { x: -room + 2, y: 52.5 }, "from above"), shape("text", { x: room - 2, y: 52.5, "text-anchor": "end" }, `gap ${gap.toFixed(0)} mm`));
  if (running?.pose) parts.push(shape("text", { x: 0, y: -48.5, "text-anchor": "middle" }, off(pose)));
  svg.replaceChildren(...parts);
  svg.setAttribute("aria-label", running?.pose ? `from above: the object is off by ${off(pose)}` : "from above: where the object is off is not known yet");
}

const off = ([x, theta]) => `${Math.abs(x).toFixed(1)} mm ${x >= 0 ? "right" : "left"}, ${Math.abs(theta).toFixed(1)}° ${theta >= 0 ? "anticlockwise" : "clockwise"}`;

function arrow(from, to) {
  if (Math.abs(to - from) < 1.5) return [];
  const side = Math.sign(to - from), tip = to - side * 0.5;
  return [shape("path", { class: "arrow", d: `M${from} 0H${tip - 3 * side}` }), shape("path", { class: "head", d: `M${tip} 0l${-4.5 * side} -3v6z` })];
}

export function drawSide(svg, running) {
  const { gap, wide } = sizes(running);
  const full = running?.expected_depth_mm ?? 25, deep = Math.max(-8, Math.min(full + 5, running?.depth_mm ?? -8));
  const x = running?.pose?.[0] ?? 0, half = gap / 2 + ASIDE, clear = 8;
  svg.setAttribute("viewBox", `${-half} -62 ${2 * half} 124`);
  const parts = [-1, 1].map((side) => shape("rect", { class: "block", x: side < 0 ? -half : gap / 2, y: 0, width: ASIDE, height: 36 }));
  const words = running ? `${Math.max(0, deep).toFixed(1)} of ${full.toFixed(0)} mm` : "";
  const below = running ? [words, "deep"] : ["from the side"];
  parts.push(shape("path", { class: "line", d: `M${-gap / 2} ${full - clear}H${gap / 2}` }), ...below.map((text, i) => shape("text", { x: 0, y: 48 + 11 * i, "text-anchor": "middle" }, text)));
  if (running) parts.push(shape("rect", { class: running.pose ? "object" : "object unknown", x: x - wide / 2, y: deep - clear - 40, width: wide, height: 40, rx: 2 }));
  svg.replaceChildren(...parts);
  svg.setAttribute("aria-label", `from the side${words && `: ${words} deep`}`);
}
