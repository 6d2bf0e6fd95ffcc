// Playback of one insertion: what both fingers felt, and slip, push and depth, all at one moment of one time axis.
import { ask, at, element, ending, withToken } from "/dashboard/dom.js";
import { chart } from "/dashboard/charts.js";
import { drawFelt } from "/dashboard/felt.js";

const FINGERS = ["left", "right"];
let shown = null; // {name, base, moments, events, plots, moment, drawn, asking} of the recording that is open; answers for another one come too late
let timer = null;

export async function play(one) {
  const mine = shown = { name: one.name, base: `/v1/recordings/${one.name}`, moments: [], events: [], plots: [] };
  at("player-title").textContent = `${one.started} UTC: ${one.object ?? "object"}, ${ending(one)}, after ${one.attempts} attempt${one.attempts === 1 ? "" : "s"}`;
  at("download").href = withToken(mine.base);
  at("answer").hidden = true;
  at("curves").replaceChildren();
  clear();
  at("then").textContent = "Reading the recording";
  at("player").showModal();
  const { ok, told } = await ask(`${mine.base}/timeline?earlier_n=${one.earlier_n}`);
  if (shown !== mine) return;
  if (!ok) { at("then").textContent = told.error; return; }
  Object.assign(mine, { moments: told.moments, events: told.events });
  at("scrub").max = Math.max(0, told.moments.length - 1);
  await draw(mine, told);
  if (shown !== mine) return;
  at("scrub").value = 0;
  show();
}

// Of the recording that was open before nothing stays: this one may have no frames, or not be readable.
function clear() {
  at("scrub").max = at("scrub").value = 0;
  at("scrub").removeAttribute("aria-valuetext");
  for (const finger of FINGERS) {
    const canvas = at(`${finger}-then`);
    canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
    canvas.classList.remove("stale");
    at(`${finger}-then-state`).textContent = "";
  }
}

// Curves of one chart may have times of their own: they are laid on the union of them.
function aligned(curves) {
  const x = [...new Set(curves.flatMap(([times]) => times))].sort((a, b) => a - b);
  return [x, curves.map(([times, values]) => { const known = new Map(times.map((time, i) => [time, values[i]])); return x.map((time) => known.get(time) ?? null); })];
}

async function draw(mine, { slip, push, depth, moments }) {
  const place = element("div"); // of this recording: another may be opened while this one waits for the library
  at("curves").replaceChildren(place);
  const end = Math.max(1, moments.at(-1)?.t ?? 1, depth[0].at(-1) ?? 1);
  const common = { key: "player", height: Math.max(110, Math.round(innerHeight / 6.2)), axis: " s", gap: 0.3, onCursor: seek, scales: { range: () => [0, end] } };
  const two = ([x, [left, right]]) => ({ x, lines: [{ colour: "busy", values: left }, { dash: [6, 4], colour: "warn", values: right }] });
  const slips = two(aligned([slip.left, slip.right]));
  for (const one of [
    { ...common, x: slips.x, lines: [...slips.lines, { colour: "quiet", dash: [2, 4], values: slips.x.map(() => 1) }], title: "Slip (right dashed; the arm stops at 1, dotted)", unit: "", over: true, range: (_, __, most) => [0, Math.max(1.5, most)] },
    { ...common, ...two(aligned([push.left, push.right])), title: "Force: push that the gels carry, in marker pitches", unit: "", over: true },
    { ...common, x: depth[0], lines: [{ colour: "good", values: depth[1] }], title: "Depth, mm", unit: "" },
  ]) {
    const plot = await chart(place, one);
    if (shown !== mine) { plot.destroy(); return; }
    mine.plots.push(plot);
  }
}

function seek(seconds) {
  let best = 0;
  shown.moments.forEach(({ t }, i) => { if (Math.abs(t - seconds) < Math.abs(shown.moments[best].t - seconds)) best = i; });
  if (best !== Number(at("scrub").value)) { at("scrub").value = best; show(); }
}

// The last that had happened by then; at the last moment also how it ended, which no frame shows.
function happened({ moments, events }, moment) {
  const after = events.filter(({ t }) => t > moment.t), last = events[events.length - after.length - 1];
  return [...(last ? [last] : []), ...(moment === moments.at(-1) ? after : [])].map(({ text }) => text).join("; ");
}

function show() {
  const mine = shown, moment = mine?.moments[Number(at("scrub").value)];
  if (!moment) { at("then").textContent = ["No frame of this insertion was judged", ...(mine?.events ?? []).map(({ text }) => text)].join("; "); return; }
  at("then").textContent = `${moment.t.toFixed(2)} s  ${happened(mine, moment)}`;
  at("scrub").setAttribute("aria-valuetext", at("then").textContent);
  for (const plot of mine.plots) plot.setCursor({ left: plot.valToPos(moment.t, "x"), top: 0 }, false);
  mine.moment = moment;
  if (!mine.asking) drawBoth(mine);
}

// Both fingers at one moment. Answers may be slow, as an insertion goes first: of the moments that come meanwhile only the newest is drawn.
async function drawBoth(mine) {
  mine.asking = true;
  while (mine.drawn !== mine.moment) {
    const { moment } = mine;
    const answers = await Promise.all(FINGERS.map((finger) => moment[finger] && ask(`${mine.base}/moments/${finger}/${moment[finger]}`)));
    if (shown !== mine) return;
    const refused = answers.find((answer) => answer && !answer.ok);
    if (refused) { stop(); at("then").textContent = refused.told.error; break; }
    FINGERS.forEach((finger, i) => drawThen(finger, answers[i]));
    mine.drawn = moment;
  }
  mine.asking = false;
}

// What a finger felt; of one without a picture at that moment the one before stays, but is no picture of it.
function drawThen(finger, answer) {
  const canvas = at(`${finger}-then`), caption = at(`${finger}-then-state`);
  canvas.classList.toggle("stale", !answer);
  if (answer) drawFelt(canvas, caption, answer.told);
  else Object.assign(caption, { textContent: "no picture", className: "bad" });
}

function stop() {
  clearInterval(timer);
  timer = null;
  at("play").textContent = "Play";
  at("then").ariaLive = "polite";
}

at("scrub").oninput = () => { stop(); show(); };
at("close").onclick = () => at("player").close();
at("player").onclose = () => {
  stop();
  if (!shown) return;
  for (const plot of shown.plots) plot.destroy(); // else its cursor would go on following those of the next
  document.querySelector(`#past button[value="${CSS.escape(shown.name)}"]`)?.focus(); // its row may be a new one by now
  shown = null;
};
at("play").onclick = () => {
  if (timer) { stop(); return; }
  if (at("scrub").value === at("scrub").max) at("scrub").value = 0;
  at("play").textContent = "Pause";
  at("then").ariaLive = "off"; // ten moments a second are no news
  timer = setInterval(() => {
    if (shown.asking) return; // no moment goes by unseen
    if (at("scrub").value === at("scrub").max) { stop(); return; }
    at("scrub").value = Number(at("scrub").value) + 1;
    show();
  }, 100);
};
at("again").onclick = async () => {
  const mine = shown;
  at("answer").hidden = false;
  at("answer").textContent = "Deciding again with the networks that decided it";
  const { ok, told } = await ask(`${mine.base}/decide`, { method: "POST" });
  if (shown !== mine) return;
  at("answer").textContent = ok ? told.lines.join("\n") : told.error;
  at("answer").scrollIntoView({ block: "nearest" });
};
