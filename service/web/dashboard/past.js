// Past insertions: a list, and playback of the frames each decision rested on.
import { withToken } from "/dashboard/token.js";
const at = (id) => document.getElementById(id);
let chosen = null;
let timer = null;

// How it ended and, unless it was inserted or a person stopped it, why.
function ended({ outcome, cause }) {
  const said = outcome.replaceAll("_", " ");
  return cause && cause !== outcome && outcome !== "aborted" ? `${said} (${cause.replaceAll("_", " ")})` : said;
}

export async function listPast() {
  const answer = await fetch(withToken("/v1/recordings"));
  if (!answer.ok) return;
  const { recordings, problems } = await answer.json();
  const broken = problems.map((text) => Object.assign(document.createElement("p"), { className: "bad", textContent: text }));
  at("past").replaceChildren(...broken, ...recordings.map((recording) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = `${recording.started.slice(11, 16)} ${recording.object ?? ""} ${ended(recording)} ${recording.attempts}: ${recording.insertion_id}`;
    button.title = `${recording.started} UTC, insertion ${recording.insertion_id}: ${ended(recording)} after ${recording.attempts} attempts`;
    button.onclick = () => choose(recording);
    return button;
  }));
}

function choose(recording) {
  chosen = recording;
  at("player-title").textContent = `${recording.started} UTC · ${recording.insertion_id}: ${ended(recording)} after ${recording.attempts} attempts`;
  at("download").href = withToken(`/v1/recordings/${recording.name}`);
  at("past-decision").textContent = recording.decided.length ? "" : "No attempt of this insertion was decided.";
  at("still").hidden = recording.decided.length === 0;
  at("scrub").value = 0;
  at("player").showModal();
  at("attempt").replaceChildren(...recording.decided.map((number) => new Option(number, number)));
  show();
}

async function show() {
  if (!chosen || !at("attempt").value) return;
  const base = `/v1/recordings/${chosen.name}/attempts/${at("attempt").value}`;
  at("still").src = withToken(`${base}/frames/${at("scrub").value}.jpg`);
  at("frame").textContent = `frame ${Number(at("scrub").value) + 1}`;
  at("scrub").setAttribute("aria-valuetext", at("frame").textContent);
  const answer = await fetch(withToken(base));
  const attempt = await answer.json();
  at("scrub").max = attempt.frames_n - 1;
  at("past-decision").textContent = attempt.decision.reason ? `${attempt.decision.type}: ${attempt.decision.reason}` : attempt.decision.type;
}

at("scrub").oninput = show;
at("close").onclick = () => at("player").close();
at("player").onclose = () => clearInterval(timer);
at("attempt").onchange = () => { at("scrub").value = 0; show(); };
at("play").onclick = () => {
  clearInterval(timer);
  at("scrub").value = 0;
  timer = setInterval(() => {
    if (Number(at("scrub").value) >= Number(at("scrub").max)) clearInterval(timer);
    else at("scrub").value = Number(at("scrub").value) + 1;
    show();
  }, 250);
};
