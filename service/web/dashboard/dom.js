// What every part of the page uses: elements, and the access token of its address passed on to all it asks for.
const token = new URLSearchParams(location.search).get("token");

export const at = (id) => document.getElementById(id);
export const element = (kind, properties = {}, ...children) => { const made = Object.assign(document.createElement(kind), properties); made.append(...children); return made; };
export const ending = ({ outcome, cause }) => (outcome === "regrasped" ? outcome : [...new Set([outcome, cause])].filter(Boolean).join(": ").replaceAll("_", " "));
export const withToken = (path) => (token ? `${path}${path.includes("?") ? "&" : "?"}token=${encodeURIComponent(token)}` : path);

// A text is touched only when it changes: what is set anew is also announced anew.
export const say = (id, text) => { if (at(id).textContent !== text) at(id).textContent = text; };

// A list is built anew while the keyboard is in it: the focus stays on the button of the same value.
export function renew(list, rows) {
  const worked = list.contains(document.activeElement) ? document.activeElement.value : undefined;
  list.replaceChildren(...rows);
  if (worked !== undefined) (list.querySelector(`button[value="${CSS.escape(worked)}"]`) ?? list.closest("[tabindex]")).focus({ preventScroll: true });
}

// What the service answers: whether it did as asked, its status, and what it tells. One that is not there is an error, too.
export async function ask(path, options) {
  try {
    const answer = await fetch(withToken(path), options);
    return { ok: answer.ok, status: answer.status, told: await answer.json() };
  } catch {
    return { ok: false, status: 0, told: { error: "The service does not answer: try again" } };
  }
}
