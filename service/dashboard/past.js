// Past insertions: a list, and playback of the frames each decision rested on.
import { withToken } from "/dashboard/token.js";
const at = (id) => document.getElementById(id);
let chosen = null;
let timer = null;

export async function listPast() {
  const answer = await fetch(withToken("/v1/recordings"));
  if (!answer.ok) return;
  const { recordings } = await answer.json();
  at("past").replaceChildren(...recordings.map((recording) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = `${recording.started}  ${recording.insertion_id}: ${recording.outcome}, ${recording.attempts} attempts`;
    button.onclick = () => choose(recording);
    return button;
  }));
}

function choose(recording) {
  chosen = recording;
  at("player").hidden = recording.decided.length === 0;
  at("attempt").replaceChildren(...recording.decided.map((number) => new Option(number, number)));
  show();
}

async function show() {
  if (!chosen || !at("attempt").value) return;
  const base = `/v1/recordings/${chosen.name}/attempts/${at("attempt").value}`;
  at("still").src = withToken(`${base}/frames/${at("scrub").value}.jpg`);
  at("frame").textContent = `frame ${Number(at("scrub").value) + 1}`;
  const answer = await fetch(withToken(base));
  const attempt = await answer.json();
  at("scrub").max = attempt.frames_n - 1;
  at("past-decision").textContent = attempt.decision.reason ? `${attempt.decision.type}: ${attempt.decision.reason}` : attempt.decision.type;
}

at("scrub").oninput = show;
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
