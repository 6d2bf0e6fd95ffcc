// The page: one WebSocket of events in, a few drawings out. No build step, no library.
import { withToken } from "/dashboard/token.js";
import { drawFinger, drawPlane } from "/dashboard/draw.js";
import { listPast } from "/dashboard/past.js";

const at = (id) => document.getElementById(id);
const state = { attempts: [], belief: null, images: {} };

function say(text, kind) {
  const status = at("status");
  status.textContent = text;
  status.className = kind;
}

function bars(place, entries, unit, best) {
  const largest = Math.max(1e-9, ...entries.map(([, value]) => value));
  place.replaceChildren(...entries.map(([name, value]) => {
    const row = document.createElement("div");
    row.className = name === best ? "bar best" : "bar";
    row.setAttribute("role", "listitem");
    const label = document.createElement("span");
    label.textContent = name;
    const track = document.createElement("span");
    const bar = document.createElement("i");
    bar.style.width = `${(100 * value) / largest}%`;
    track.append(bar);
    const number = document.createElement("b");
    number.textContent = unit === "%" ? `${Math.round(100 * value)} %` : value.toFixed(1);
    row.append(label, track, number);
    return row;
  }));
}

const STAGES = { networks_last_step: "networks", since_last_frame: "from last frame", rectify: "rectify", markers: "markers", slip: "slip", controller: "controller" };
const NOT_LIVE = "cameras not live";
const signed = (value) => (value >= 0 ? "+" : "") + value.toFixed(1);

function told(message) {
  switch (message.type) {
    case "hello": return `connected, controller ${message.controller}`;
    case "armed": return `attempt ${message.attempt} armed`;
    case "enough": return `attempt ${message.attempt}: pressed by ${message.pressed_mm.toFixed(1)} mm, stopped`;
    case "slip": return `attempt ${message.attempt}: slip, ${message.finger} finger, seen after ${message.age_ms.toFixed(0)} ms`;
    case "correction": return `attempt ${message.attempt}: move ${signed(message.dx_mm)} mm, turn ${signed(message.dtheta_deg)}°`;
    case "no_decision": return `attempt ${message.attempt}: no decision, ${message.detail}`;
    case "refused": return `attempt ${message.attempt}: refused, ${message.detail}`;
    case "finished": return `${message.outcome.replaceAll("_", " ")} after ${message.attempts} attempts${message.cause ? `: ${message.cause.replaceAll("_", " ")}` : ""}`;
    default: return `${message.code ?? message.type}: ${message.detail ?? ""}`;
  }
}

function onMessage(message) {
  const line = document.createElement("li");
  line.className = message.type;
  const when = document.createElement("time");
  when.textContent = new Date().toLocaleTimeString("en-GB");
  line.append(when, told(message));
  at("timeline").prepend(line);
  if (message.type === "hello") { state.attempts = []; state.belief = null; at("timeline").replaceChildren(line); at("move").textContent = "none yet"; at("reason").textContent = ""; }
  if (message.type === "armed") say(`Attempt ${message.attempt}: feeling`, "good");
  if (message.type === "slip") say(`Attempt ${message.attempt}: slip, stopped`, "warn");
  if (message.type === "fault") say(message.code.replaceAll("_", " "), "bad");
  if (message.type === "refused") say(message.reason.replaceAll("_", " "), "bad");
  if (message.type === "no_decision") say(`Attempt ${message.attempt}: no decision`, "bad");
  if (message.type === "finished") { say(`${message.outcome}, ${message.attempts} attempts`, message.outcome === "inserted" ? "good" : "bad"); }
  if (message.type === "correction") onCorrection(message);
  drawPlane(at("plane"), state);
}

function onCorrection(message) {
  say(`Attempt ${message.attempt}: corrected`, "good");
  const e = message.estimate;
  at("move").textContent = `Move ${signed(message.dx_mm)} mm\nturn ${signed(message.dtheta_deg)}°`;
  at("reason").textContent = `Felt ${signed(e.dx_mm)} mm, ${signed(e.dtheta_deg)}°. ${message.reason}`;
  const classes = Object.entries(message.class_probabilities);
  bars(at("bars"), classes, "%", classes.reduce((a, b) => (b[1] > a[1] ? b : a))[0]);
  bars(at("latency"), Object.entries(message.latency_ms).map(([name, ms]) => [STAGES[name] ?? name, ms]), "ms");
  state.attempts.push({ x: e.dx_mm, theta: e.dtheta_deg, sx: e.sigma_x_mm, st: e.sigma_theta_deg, number: message.attempt });
}

// A count that grew within the last minute; one that grew long ago must not stay red until the service restarts.
function growing(count) {
  if (state.dropped !== undefined && count > state.dropped) state.grewAt = Date.now();
  state.dropped = count;
  return Date.now() - (state.grewAt ?? -Infinity) < 60_000;
}

function onHealth(health) {
  const cameras = Object.entries(health.cameras).map(([finger, c]) => [c.state === "live" ? "good" : "bad", `${finger} ${c.state === "live" && c.frame_rate_hz ? c.frame_rate_hz.toFixed(0) + " Hz" : c.state}`]);
  const robot = [health.driver ? "good" : "off", health.driver ? `robot ${health.driver}` : "no robot"];
  const dropped = [growing(health.frames_dropped_n) ? "bad" : "good", `dropped ${health.frames_dropped_n}`];
  const kept = health.recording ? [["bad", `not recorded: ${health.recording}`]] : [];
  at("health").replaceChildren(...[...cameras, robot, dropped, ...kept].map(([kind, text]) => Object.assign(document.createElement("li"), { className: kind, textContent: text })));
  if (!health.ready) say(NOT_LIVE, "bad");
  else if (at("status").textContent === NOT_LIVE || (!health.driver && at("status").className === "")) say("ready", "good");
}

function onFinger(content) {
  const state = at(`${content.finger}-state`);
  state.textContent = `${content.state.replaceAll("_", " ")}, slip ${content.score.toFixed(2)}`;
  state.className = content.state.includes("slip") ? "slip" : "";
  const image = new Image();
  image.onload = () => drawFinger(at(content.finger), image, content);
  image.src = `data:image/jpeg;base64,${content.jpeg}`;
}

function connect() {
  const socket = new WebSocket(withToken(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/v1/live`));
  socket.onopen = () => { at("status").className = ""; say("ready", ""); };
  socket.onmessage = ({ data }) => {
    const { kind, content } = JSON.parse(data);
    if (kind === "message") onMessage(content);
    else if (kind === "finger") onFinger(content);
    else if (kind === "belief") { state.belief = content; drawPlane(at("plane"), state); }
    else if (kind === "health") onHealth(content);
    else if (kind === "recorded") listPast();
  };
  socket.onclose = () => { say("service not reachable", "bad"); setTimeout(connect, 1000); };
}

drawPlane(at("plane"), state);
listPast();
connect();
