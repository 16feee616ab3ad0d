/* A run that is being taken: what it covers, what is known, what next; asked for every second. */
const $ = (id) => document.getElementById(id);
let shown = "", lost = false;

function number(x, digits = 3) { return x === null || x === undefined ? "not determined" : tomoposeNumbers.significant(x, digits); }

function cells(id, rows) {
  $(id).replaceChildren(...rows.map((row) => {
    const line = document.createElement("tr");
    row.forEach((text) => { const cell = document.createElement("td"); cell.textContent = text; line.append(cell); });
    return line;
  }));
}

function items(id, texts) {
  $(id).replaceChildren(...texts.map((text) => { const item = document.createElement("li"); item.textContent = text; return item; }));
}

function panel(state) {
  const seen = state.arrived.filter((a) => a.x), u = state.n_u - 0.5, v = state.n_v - 0.5;
  const axis = (title, more) => ({ title: { text: title }, ...more });
  tomoposePlots.draw($("plot"), {
    data: [
      { type: "scatter", mode: "lines", x: [-0.5, u, u, -0.5, -0.5], y: [-0.5, -0.5, v, v, -0.5], line: { color: "#5b6775", width: 1.5 }, hoverinfo: "skip", showlegend: false },
      { type: "scatter", mode: "markers", x: seen.map((a) => a.x[0]), y: seen.map((a) => a.x[1]), text: seen.map((a) => a.pose), marker: { size: 7, color: "#1f5f99" }, hovertemplate: "%{text}", showlegend: false },
    ],
    layout: { xaxis: axis("u / px"), yaxis: axis("v / px", { scaleanchor: "x", scaleratio: 1 }), showlegend: false },
  });
}

function show(state) {
  $("verdict").textContent = `${state.arrived.length} of ${state.expected} images${state.verdict ? ` · ${state.verdict}` : ""}`;
  $("verdict").className = `verdict ${state.failed ? "rejected" : state.verdict || ""}`;
  $("said").textContent = state.words || "";
  $("scan").textContent = state.scan_px === undefined || state.scan_px === null ? "" : `Error of a tilted scan so far: ${number(state.scan_px)} px (standard uncertainty).`;
  const c = state.coverage;
  $("panel-words").textContent = c ? `The ball was seen in ${Math.round(100 * c.panel)} % of the panel's parts; table angles: ${c.table_angles.join("°, ")}°.` : "";
  cells("spans", c ? Object.entries(c.spans).map(([name, span]) => [name, number(span)]) : []);
  cells("sigma", (state.sigma || []).map((p) => [p.name, p.u]));
  items("alike", state.indistinguishable || (state.undetermined && state.undetermined.length ? [state.undetermined.join(", ")] : ["nothing is known yet"]));
  const n = state.next;
  $("next-words").textContent = n
    ? `x ${number(n.axes[0])}, y ${number(n.axes[1])}, z ${number(n.axes[2])} mm; angles ${n.axes.slice(3).map((a) => number(a)).join(", ")}°; table ${number(n.alpha_deg)}°. Error of a tilted scan: ${number(n.before)} px now, ${number(n.after)} px with it.`
    : state.next_words || "";
  $("command").textContent = state.command || "";
  $("copy").disabled = !state.command;
  items("decisions", state.arrived.slice().reverse().map((a) => `${a.pose}: ${a.status}`));
  panel(state);
  document.body.dataset.arrived = String(state.arrived.length);
}

async function look() {
  try {
    const answer = await fetch("state"), text = await answer.text();
    if (!answer.ok) throw new Error(text);
    if (text !== shown || lost) { shown = text; lost = false; show(JSON.parse(text)); }
  } catch (error) {
    lost = true;
    $("said").textContent = `the run is not being watched any more (${error.message})`;
  }
  setTimeout(look, 1000);
}

async function copy() {
  const text = $("command").textContent;
  if (!text) return;
  try {
    await navigator.clipboard.writeText(text);
    $("copied").textContent = "copied";
  } catch (error) { /* not allowed: the text is marked, so that the browser's own copy takes it */
    getSelection().selectAllChildren($("command"));
    $("copied").textContent = "marked; copy it with the browser's own key";
  }
}

$("copy").onclick = copy;
document.addEventListener("keydown", (e) => {
  if (e.ctrlKey || e.metaKey || e.altKey) return;
  if (e.key === "c") { e.preventDefault(); copy(); }
});
window.addEventListener("resize", () => { if (shown) panel(JSON.parse(shown)); });

look();
