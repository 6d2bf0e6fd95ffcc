// Insertions of the past: a table with filters, and how attempts, intervals and reach have gone.
import { ask, at, element, ending, renew } from "/dashboard/dom.js";
import { chart } from "/dashboard/charts.js";
import { play } from "/dashboard/player.js";

const FILTERS = { object: "by-object", outcome: "by-outcome", cause: "by-cause" };
const words = (text) => (text ?? "").replaceAll("_", " ");
const RECENT = 20; // insertions of a moving mean
const MEANT = ["aborted", "probed", "regrasped"]; // by a person, as a probe, or to be regrasped: neither inserted nor failed
const LISTED = 500; // insertions at most, in the table and in the trends
let all = [], more = ""; // what is listed, and whether there are others
const plots = []; // of the trends that are shown
at("by-id").oninput = show;

export async function listPast() {
  if (at("history").hidden) return;
  const { ok, told } = await ask(`/v1/recordings?newest=${LISTED + 1}`);
  if (!ok) { at("count").textContent = told.error; return; }
  const { recordings, problems } = told;
  all = recordings;
  for (const one of [...all].reverse()) {
    one.earlier_n = earlier(one);
    one.attempts = one.descended_n + one.earlier_n;
  }
  more = all.length > LISTED ? `; the newest ${LISTED} listed` : "";
  all = all.slice(0, LISTED);
  at("problems").replaceChildren(...problems.map((textContent) => element("p", { className: "bad", textContent })));
  for (const [key, id] of Object.entries(FILTERS)) options(at(id), [...new Set(all.map((one) => one[key] ?? ""))].sort());
  show();
}

// Attempts before the object was regrasped.
const earlier = ({ continues }) => (continues && all.find((one) => one.insertion_id === continues)?.attempts) || 0;

function options(select, values) {
  const chosen = select.options.length ? select.value : "*";
  select.replaceChildren(new Option("all", "*"), ...values.map((value) => new Option(words(value) || "none", value)));
  select.value = values.includes(chosen) ? chosen : "*";
  select.onchange = show;
}

function show() {
  const chosen = all.filter((one) => Object.entries(FILTERS).every(([key, id]) => at(id).value === "*" || (one[key] ?? "") === at(id).value) && one.insertion_id.includes(at("by-id").value.trim()));
  const inserted = chosen.filter(({ outcome }) => outcome === "inserted"), ended = chosen.filter(({ outcome }) => !MEANT.includes(outcome));
  const others = MEANT.map((meant) => [chosen.filter(({ outcome }) => outcome === meant).length, meant]).filter(([n]) => n).map((counted) => counted.join(" ")).join(", ");
  at("count").textContent = ended.length ? `${inserted.length} of ${ended.length} inserted${inserted.length ? `, ${mean(inserted.map((one) => one.attempts)).toFixed(2)} attempts on average` : ""}${others ? `; ${others}, not counted` : ""}${more}` : (others || "none") + more;
  renew(at("past"), chosen.map(row));
  trend(ended.reverse());
}

// By the viewer's clock, as alarms have it; the service tells UTC.
function when(started) {
  const then = new Date(`${started.replace(" ", "T")}Z`);
  return `${then.toLocaleDateString("en-GB", { day: "numeric", month: "short" })} ${then.toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit" })}`;
}

function row(one) {
  const cell = (textContent, className = "") => element("td", { textContent, className });
  const button = element("button", { type: "button", value: one.name, textContent: "Play", ariaLabel: `play back ${one.insertion_id}`, title: one.insertion_id, onclick: () => play(one) });
  return element("tr", {}, cell(when(one.started)), cell(words(one.object) || "–"), cell(ending(one), one.outcome === "inserted" ? "good" : MEANT.includes(one.outcome) ? "" : "bad"), cell(one.attempts), cell(one.seconds?.toFixed(1) ?? "–"), element("td", {}, button));
}

const mean = (values) => (values.length ? values.reduce((sum, value) => sum + value, 0) / values.length : NaN);

// Of the newest insertions up to each one.
function moving(list, of) {
  return list.map((_, i) => { const value = of(list.slice(Math.max(0, i + 1 - RECENT), i + 1)); return Number.isFinite(value) ? value : null; });
}

async function trend(list) {
  const place = element("div"); // of this call: another may begin while this one waits for the library
  for (const plot of plots.splice(0)) plot.destroy(); // else each would be kept for ever, and follow the cursor of those after it
  at("trend").replaceChildren(place);
  const room = at("trend").clientHeight; // what the panel leaves; nothing where the page scrolls
  if (list.length < 2) { place.textContent = "A trend needs two insertions."; return; }
  const x = list.map((_, i) => i + 1), key = "trend", rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
  const height = Math.max(100, Math.floor((room - (3 * 1.3 + 1.7) * rem) / 3));
  const reach = (one) => mean((one.decisions ?? []).map((decision) => decision.reach_pitch).filter((value) => value > 0));
  const sum = (part, name) => part.reduce((total, one) => total + (one[name] ?? 0), 0);
  for (const one of [
    { title: `Attempts (dots), mean of ${RECENT} (line)`, unit: "", x, key, height, over: true, range: (_, __, most) => [0, Math.max(4, most + 1)], lines: [{ colour: "gel", values: list.map((one) => one.attempts), points: true }, { colour: "busy", values: moving(list, (part) => mean(part.map((one) => one.attempts))) }] },
    { title: "90 % intervals that held the pose it went in at", unit: " %", x, key, height, over: true, range: [0, 105], lines: [{ colour: "good", values: moving(list, (part) => (100 * sum(part, "intervals_held_n")) / sum(part, "intervals_n")) }] },
    { title: "Reach: shear of the gels at the stop, in pitches", unit: "", x, key, height, range: (_, __, most) => [0, Math.max(0.5, 1.1 * most)], lines: [{ colour: "gel", values: list.map((one) => { const value = reach(one); return Number.isFinite(value) ? value : null; }), points: true }, { colour: "busy", values: moving(list, (part) => mean(part.map(reach).filter(Number.isFinite))) }] },
  ]) {
    const plot = await chart(place, one);
    if (!place.isConnected) { plot.destroy(); return; }
    plots.push(plot);
  }
}
