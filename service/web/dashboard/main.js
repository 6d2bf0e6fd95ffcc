// The page shows one state, which the service sends whole on connecting and after each change; it keeps none of its own.
import { ask, at, element, renew, say, withToken } from "/dashboard/dom.js";
import { drawFelt } from "/dashboard/felt.js";
import { drawAbove, drawSide } from "/dashboard/place.js";
import { listPast } from "/dashboard/history.js";

let today; // by the service's clock, for the viewer's may be wrong
let heard = null; // when the service was last heard: {service_s, steady_ms, viewer_ms}, by the service's clock and both of the viewer
const clock = (seconds) => { const then = new Date(1000 * seconds); return `${then.toDateString() === today ? "" : `${then.toLocaleDateString("en-GB", { day: "numeric", month: "short" })}, `}${then.toLocaleTimeString("en-GB")}`; };
const SILENT_MS = 5000;
const NO_LINK = ["The page has no connection to the service", "It connects again by itself."];
const NO_TOKEN = ["The address of this page lacks the token, or has a wrong one", "Open it with ?token= and the token of --token-watch behind the address."];
const TOO_MANY = ["Too many pages are open", "This one connects by itself once another one is closed."];
let newest = null;
let noLink = NO_LINK;
let grew = { count: undefined, at: -Infinity };

function show(status) {
  const { headline, running, last, alarms } = status;
  today = new Date(1000 * status.now_s).toDateString();
  heard = { service_s: status.now_s, steady_ms: performance.now(), viewer_ms: Date.now() };
  document.body.classList.remove("stale");
  showHeadline(headline);
  const stop = alarms.find((alarm) => alarm.level === "stop" && !alarm.acknowledged_s);
  showAcknowledge(headline.level === "stop" && stop);
  at("acknowledge").onclick = () => acknowledge(stop.number);
  drawAbove(at("above"), running);
  drawSide(at("side"), running);
  showNext(running, last);
  showAlarms(alarms, status.open_alarms_n);
  const events = status.events.map(({ at_s, text }) => element("li", {}, element("time", { textContent: clock(at_s) }), element("span", { textContent: text })));
  at("events").replaceChildren(...(events.length ? events : [element("li", { textContent: "Nothing yet" })]));
  showHealth(status.health);
  if (status.recorded !== newest) { newest = status.recorded; listPast(); } // an insertion is listed once it is kept, not once it has ended
}

function showHeadline({ level, words, detail }) {
  at("headline").className = level;
  at("words").ariaLive = level === "stop" ? "assertive" : "polite";
  say("words", words);
  say("detail", detail);
}

function showAcknowledge(wanted) {
  const worked = document.activeElement === at("acknowledge");
  at("acknowledge").hidden = !wanted;
  if (worked && !wanted) at("words").focus(); // else the keyboard would be nowhere
}

function showNext(running, last) {
  const move = running?.move, most = running?.attempts_max ?? 15, used = running?.attempt ?? 0;
  at("next-title").textContent = move && !running.target ? "Last move" : "Next move";
  at("move").textContent = move ? move.words.replace(", ", "\n") : running ? "None yet" : "No insertion under way";
  at("move").className = !move ? "none" : move.sure.startsWith("guess") ? "guess" : "";
  at("felt").textContent = move ? `felt ${move.felt} of the gap` : running ? "" : last ? `Last: ${last.words}${last.seconds ? `, ${last.seconds.toFixed(0)}\u00a0s` : ""}` : "";
  at("confidence").hidden = !move;
  at("attempts").hidden = !running;
  at("sure").textContent = move ? `${move.sure}, ${Math.round(100 * move.confidence)} %` : "";
  at("meter").value = move?.confidence ?? 0;
  at("attempts").replaceChildren(...Array.from({ length: most }, (_, i) => element("li", { className: i + 1 < used ? "used" : i + 1 === used ? "now" : "" })));
  at("left-over").textContent = running ? `${most - used} of ${most} attempts left` : "";
}

const DOUBLE_MS = 500; // of a double click, at most
let pressed = -Infinity;
const SIGNS = { stop: "■", warning: "▲" };
let listed = "";

function showAlarms(alarms, open) {
  say("open-alarms", open ? String(open) : "");
  at("open-alarms").className = alarms.some((alarm) => alarm.level === "stop" && !alarm.acknowledged_s) ? "stop" : "";
  const list = JSON.stringify([today, alarms]);
  if (list === listed) return; // a list that is worked on stays put
  listed = list;
  const shown = alarms.map((alarm) => {
    const state = alarm.acknowledged_s ? "acknowledged" : alarm.active ? "still there" : "gone, not acknowledged";
    const facts = `${clock(alarm.at_s)}${alarm.times_n > 1 ? `, ${alarm.times_n} times` : ""}, ${alarm.level === "stop" && !alarm.acknowledged_s ? "not acknowledged" : state}`;
    const item = element("li", { className: `${alarm.level} ${alarm.acknowledged_s ? "seen" : ""}` }, element("span", { className: "sign", textContent: SIGNS[alarm.level], ariaHidden: "true" }), element("b", { textContent: alarm.title }));
    item.append(...[[facts, alarm.remedy].filter(Boolean).join(". "), alarm.detail].filter(Boolean).map((textContent) => element("small", { textContent })));
    if (!alarm.acknowledged_s) item.append(element("button", { type: "button", value: alarm.number, textContent: "Seen", ariaLabel: `acknowledge: ${alarm.title}`, onclick: () => acknowledge(alarm.number) }));
    return item;
  });
  renew(at("alarms"), shown.length ? shown : [element("li", { textContent: "None" })]);
}

// After one press the next alarm stands in its place: so soon after it a second press is of somebody who has not read that.
async function acknowledge(number) {
  if (performance.now() - pressed < DOUBLE_MS) return;
  pressed = performance.now();
  await ask(`/v1/alarms/${number}/acknowledge`, { method: "POST" });
}

// Frames dropped within the last minute; what happened long ago must not stay red until the service restarts.
function growing(count) {
  if (grew.count !== undefined && count > grew.count) grew.at = performance.now();
  grew.count = count;
  return performance.now() - grew.at < 60_000;
}

function showHealth(health) {
  for (const [finger, { state }] of Object.entries(health.cameras)) showUnseen(finger, state !== "live");
  const items = Object.entries(health.cameras).map(([finger, c]) => [c.state === "live" ? "good" : "bad", `${finger} ${c.state === "live" && c.frame_rate_hz ? `${c.frame_rate_hz.toFixed(0)} Hz` : c.state}`]);
  items.push([health.driver ? "good" : "off", health.driver ? "robot" : "no robot"]);
  if (growing(health.frames_dropped_n)) items.push(["bad", `dropped ${health.frames_dropped_n}`]);
  items.push(health.recording ? ["bad", "not recorded"] : ["good", "recording"]);
  items.push(...health.versions.map((words, i) => [i ? "off" : "good", words]));
  if (health.versions_problem) items.push(["bad", health.versions_problem]);
  at("health").replaceChildren(...items.map(([className, textContent]) => element("li", { className, textContent })));
}

// The last picture of a camera that delivers no more is no live one.
function showUnseen(finger, unseen) {
  at(finger).classList.toggle("stale", unseen);
  if (unseen) Object.assign(at(`${finger}-state`), { textContent: "no picture", className: "bad" });
}

function view() {
  const history = location.hash === "#history";
  at("live").hidden = history;
  at("history").hidden = !history;
  for (const link of document.querySelectorAll("nav a")) {
    if (link.hash === (history ? "#history" : "#live")) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  if (history) listPast();
}

// What is shown stays, for a person may need it, but grey, and with when it was true: on a day that is over also which.
function showLost([words, remedy]) {
  document.body.classList.toggle("stale", heard !== null);
  if (heard) { // the steady clock stands still while a laptop sleeps, and the other one may be set back
    const silent_ms = Math.max(performance.now() - heard.steady_ms, Date.now() - heard.viewer_ms);
    today = new Date(1000 * heard.service_s + silent_ms).toDateString();
  }
  const detail = heard ? `What is shown below is of ${clock(heard.service_s)}. ${remedy}` : remedy;
  showHeadline({ level: "stop", words, detail });
  showAcknowledge(false);
  for (const button of at("alarms").querySelectorAll("button")) button.disabled = true;
  listed = ""; // with a link the list is shown anew
  at("health").replaceChildren(element("li", { className: "bad", textContent: "not connected" }));
}

// The service sends its state every second. A link that is half open never closes, so silence ends it, too.
function connect() {
  const socket = new WebSocket(withToken(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/v1/live`));
  let patience = setTimeout(lost, SILENT_MS);
  function lost({ code } = {}) {
    clearTimeout(patience);
    socket.onmessage = socket.onclose = null;
    socket.close();
    showLost(code === 1013 ? TOO_MANY : noLink);
    setTimeout(connect, 1000);
    ask("/v1/status", { signal: AbortSignal.timeout(SILENT_MS) }).then(({ status }) => { // a browser hides why it was not let in
      noLink = status === 401 ? NO_TOKEN : NO_LINK;
      if (noLink === NO_TOKEN) showLost(noLink);
    });
  }
  socket.onclose = lost;
  socket.onmessage = ({ data }) => {
    clearTimeout(patience);
    patience = setTimeout(lost, SILENT_MS);
    const { kind, content } = JSON.parse(data);
    if (kind === "status") show(content);
    else drawFelt(at(content.finger), at(`${content.finger}-state`), content);
  };
}

addEventListener("hashchange", view);
drawAbove(at("above"), null);
drawSide(at("side"), null);
view();
connect();
