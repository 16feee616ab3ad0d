/* The page of a review: rows worst first, a picture, decisions by keys, and the calibration that follows. */
import { Picture } from "./picture.js";

const $ = (id) => document.getElementById(id);
const FAR = 4; /* times the usual residual: marked in the list */
let state = null, figures = [], place = 0, tab = 0, moving = false, busy = 0, queue = Promise.resolve();

async function ask(path, content) {
  const options = content === undefined ? {} : { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(content) };
  const answer = await fetch(path, options), found = await answer.json();
  if (!answer.ok) throw new Error(found.error || answer.statusText);
  return found;
}

async function loadCrop(k, u, v, half) {
  if (!state.pictures) return null;
  const answer = await fetch(`crop/${k}?u=${u}&v=${v}&half=${half}`);
  if (!answer.ok) { say(await answer.text()); return null; }
  const head = JSON.parse(answer.headers.get("x-crop")), bytes = await answer.arrayBuffer();
  return { ...head, data: head.kind === "uint16" ? new Uint16Array(bytes) : new Float32Array(bytes) };
}

const picture = new Picture($("picture"), loadCrop);
const current = () => state.order[place];
const row = () => state.rows[current()];

function number(x, digits = 3) { return x === null || x === undefined ? "–" : tomoposeNumbers.significant(x, digits); }

function say(text) { $("said").textContent = text; }

function element(tag, text, attributes = {}) {
  const e = document.createElement(tag);
  e.textContent = text;
  Object.entries(attributes).forEach(([k, v]) => e.setAttribute(k, v));
  return e;
}

const MARKS = { accept: "✓", "leave-out": "✗", "measure-again": "↻" };

function showRows() {
  const list = $("rows");
  if (list.children.length !== state.order.length) {
    list.replaceChildren(...state.order.map((k, i) => {
      const item = document.createElement("li"), button = document.createElement("button");
      button.type = "button";
      button.tabIndex = -1;
      button.append(element("span", ""), element("span", "", { class: "name" }), element("span", ""));
      button.onclick = () => go(i);
      item.append(button);
      return item;
    }));
  }
  state.order.forEach((k, i) => {
    const r = state.rows[k], button = list.children[i].firstChild, [mark, name, far] = button.children;
    mark.textContent = MARKS[r.decision] || (r.used ? "·" : "–");
    name.textContent = r.pose;
    far.textContent = r.times === null ? "none" : `${number(r.times, 2)} ×`;
    far.className = r.times === null || r.times > FAR ? "far" : "";
    button.tabIndex = i === place ? 0 : -1;
    button.setAttribute("aria-current", String(i === place));
    button.setAttribute("aria-label", `${r.pose}, ${r.decision || (r.used ? "used" : "set aside")}, ${far.textContent}`);
  });
  const here = list.children[place];
  if (here) list.scrollTop = here.offsetTop - list.offsetTop - list.clientHeight / 2;
}

function showRow() {
  const r = row();
  $("pose").textContent = `${r.pose} (${place + 1} of ${state.order.length})`;
  $("numbers").replaceChildren(...[
    ["residual / px", number(r.d)], ["σ / px", number(r.sigma)], ["times usual", number(r.times, 2)], ["in the fit", r.used ? "yes" : "no"],
  ].map(([name, value]) => { const d = document.createElement("div"); d.append(element("dt", name), element("dd", value)); return d; }));
  $("status").textContent = [r.status, r.words && !r.status.includes(r.words) ? r.words : ""].filter(Boolean).join(" · ");
  $("picture").setAttribute("aria-label", `radiograph of ${r.pose} about the ball; silhouette found orange, centre predicted blue`);
  if (state.pictures) {
    picture.show(current(), r).catch((error) => say(error.message));
    [1, 2, 3].forEach((step) => { const k = state.order[place + step]; if (k !== undefined) picture.crop(k, state.rows[k]); });
  }
}

function showResult() {
  const r = state.result;
  $("verdict").textContent = `${r.verdict} · d_rms ${number(r.d_rms)} px (${number(r.d_rms_um)} µm) · ${r.used} used, ${r.aside} set aside`;
  $("verdict").className = `verdict ${r.verdict}`;
  $("findings").replaceChildren(...(r.findings.length ? r.findings : [{ words: "none of the checks gave a reason for doubt", verdict: "trustworthy", fix: "" }])
    .map((f) => element("li", f.words + (f.fix ? ` (${f.fix})` : ""), { class: f.verdict })));
  $("parameters").replaceChildren(...r.parameters.map((p) => {
    const line = document.createElement("tr");
    line.append(element("td", p.name, { title: p.meaning }), element("td", p.value), element("td", p.u));
    return line;
  }));
  $("decisions").replaceChildren(...state.decisions.slice().reverse().map((d) => element("li", `${d.pose} ${d.words}`)));
}

function showFigure() {
  const f = figures[tab];
  if (!f) return;
  Array.from($("tabs").children).forEach((b, k) => { b.setAttribute("aria-selected", String(k === tab)); b.tabIndex = k === tab ? 0 : -1; });
  $("panel").setAttribute("aria-labelledby", `tab-${tab}`);
  $("plot").dataset.height = f.height;
  $("plot").setAttribute("aria-label", `${f.title}: ${f.meaning}`);
  tomoposePlots.draw($("plot"), f);
  $("caption").textContent = `${f.meaning} ${f.look_for}`;
}

/* Figures follow when no decision waits: they never hold up the next one. */
async function showFigures() {
  figures = (await ask("figures")).figures;
  const tabs = $("tabs");
  if (tabs.children.length !== figures.length) {
    tabs.replaceChildren(...figures.map((f, k) => {
      const b = element("button", f.tab, { type: "button", role: "tab", id: `tab-${k}`, "aria-controls": "panel" });
      b.onclick = () => { tab = k; showFigure(); };
      return b;
    }));
  }
  tab = Math.min(tab, Math.max(0, figures.length - 1));
  showFigure();
}

function go(i) {
  place = Math.max(0, Math.min(state.order.length - 1, i));
  stopMoving();
  showRows();
  showRow();
}

function nextUndecided() {
  const n = state.order.length, i = [...Array(n).keys()].map((s) => (place + 1 + s) % n).find((j) => !state.rows[state.order[j]].decision);
  go(i === undefined ? place + 1 : i);
}

/* An answer holds what changed: what of the rows differs, by number, decisions after those that stay, a result where it was solved again. */
function merge(found) {
  const rows = state.rows.slice();
  Object.entries(found.rows).forEach(([k, row]) => { rows[k] = { ...rows[k], ...row }; });
  state = { ...state, rows, decisions: [...state.decisions.slice(0, found.keep), ...found.decisions], result: found.result ?? state.result };
}

/* Changes are sent one after the other; the keyboard is never held up by them. */
function change(path, content, done) {
  busy += 1;
  document.body.dataset.busy = String(busy);
  queue = queue.then(() => ask(path, content)).then((found) => {
    if (found.rows) { merge(found); showRows(); showRow(); showResult(); say(`solved again in ${found.solve_ms.toFixed(0)} ms`); }
    if (done) done(found);
  }).catch((error) => say(error.message)).finally(() => {
    busy -= 1;
    document.body.dataset.busy = String(busy);
    if (!busy) showFigures().catch((error) => say(error.message));
  });
}

function decide(action, start) {
  const content = { row: current(), action: action, why: $("why").value };
  if (start) content.start = start;
  change("decide", content);
  $("why").value = "";
  if (action !== "measure-again") go(place + 1);
}

function stopMoving() {
  moving = false;
  picture.start = null;
  document.body.classList.remove("moving");
}

function move(key, shift) {
  const step = shift ? 10 : 1, by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[key];
  if (key === "Enter") { const start = picture.start; stopMoving(); decide("measure-again", start); return true; }
  if (key === "Escape") { stopMoving(); picture.draw(); return true; }
  if (!by) return false;
  picture.start = [picture.start[0] + by[0] * step, picture.start[1] + by[1] * step];
  picture.draw();
  return true;
}

const KEYS = {
  j: () => go(place + 1), ArrowDown: () => go(place + 1), ArrowRight: () => go(place + 1),
  k: () => go(place - 1), ArrowUp: () => go(place - 1), ArrowLeft: () => go(place - 1),
  n: nextUndecided, a: () => decide("accept"), x: () => decide("leave-out"), u: () => change("undo", {}),
  s: () => change("save", {}, (found) => say(`written: ${found.written.join(", ")}`)),
  m: () => {
    if (!state.pictures) { say("without radiographs nothing can be measured again"); return; }
    moving = true;
    picture.start = picture.centreOf(row()).slice();
    picture.draw();
    say("move the start point with the arrows; Enter fits again, Esc stops");
  },
  w: () => $("why").focus(),
  "+": () => zoom(1 / 1.3), "=": () => zoom(1 / 1.3), "-": () => zoom(1.3),
  "[": () => light(0.1, 1), "]": () => light(-0.1, 1), "{": () => light(0, 1.2), "}": () => light(0, 1 / 1.2),
};

function zoom(factor) {
  picture.half = Math.max(8, Math.min(512, Math.round(picture.halfOf(row()) * factor)));
  picture.show(current(), row());
}

function light(level, spread) {
  picture.level += level * picture.spread;
  picture.spread *= spread;
  picture.draw();
}

document.addEventListener("keydown", (e) => {
  if (!state || e.ctrlKey || e.metaKey || e.altKey) return;
  if (e.target.id === "why") { if (e.key === "Enter" || e.key === "Escape") e.target.blur(); return; }
  if (moving && move(e.key, e.shiftKey)) { e.preventDefault(); return; }
  if (e.target.id === "panel" && e.key.startsWith("Arrow")) return;
  if (/^[1-7]$/.test(e.key) && figures[e.key - 1]) { tab = e.key - 1; showFigure(); return; }
  const act = KEYS[e.key];
  if (act) { e.preventDefault(); act(); }
});
document.querySelectorAll(".buttons button").forEach((b) => { b.onclick = () => KEYS[b.dataset.key](); });
$("picture").addEventListener("click", (e) => {
  if (!moving) return;
  picture.start = picture.pixelAt(e.offsetX, e.offsetY);
  picture.draw();
});
window.addEventListener("resize", () => { picture.draw(); showFigure(); });
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", showFigure);

ask("state").then((found) => {
  state = found;
  showRows();
  showRow();
  showResult();
  say(`${state.who} reviews; ${state.decisions.length} decisions so far`);
  document.body.dataset.ready = "yes";
  document.body.dataset.busy = "0";
  return showFigures();
}).catch((error) => say(error.message));
