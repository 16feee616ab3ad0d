"use strict";
/* A figure in its element: legend, plot, hover text; drawn when it is scrolled to, and again when its width changes. */
const tomoposePlots = (function () {
  const states = new WeakMap();

  function isSolid(figure) {
    return figure.data.some(function (t) { return t.type === "scatter3d" || t.type === "mesh3d"; });
  }

  function named(figure) {
    const seen = new Set();
    return figure.data.filter(function (t) {
      const key = t.legendgroup || t.name;
      if (!t.name || t.showlegend === false || seen.has(key)) return false;
      seen.add(key);
      return true;
    });
  }

  function colourOf(t) {
    const thin = ((t.marker || {}).symbol || "").includes("thin") && t.marker.line;
    if (thin) return t.marker.line.color;
    const colour = (t.mode || "").includes("lines") && t.line ? t.line.color : (t.marker || {}).color || (t.line || {}).color || t.color;
    return typeof colour === "string" ? colour : Array.isArray(colour) && typeof colour[0] === "string" ? colour[0] : "#1f5f99";
  }

  /* Names with their colours; a button hides and shows what it names. */
  function legend(element, figure, state) {
    const traces = named(figure);
    if (figure.layout.showlegend === false || traces.length < 1 || (figure.layout.showlegend !== true && figure.data.length < 2)) return;
    const row = document.createElement("div");
    row.className = "legend";
    traces.forEach(function (t) {
      const b = document.createElement("button"), swatch = document.createElement("span"), key = t.legendgroup || t.name;
      b.type = "button";
      b.setAttribute("aria-pressed", String(!state.hidden.has(key)));
      swatch.className = "swatch" + ((t.mode || "").includes("lines") ? " stroke" : "");
      swatch.style.background = tomoposeNumbers.ink(colourOf(t));
      b.append(swatch, String(t.name).replace(/<[^>]*>/g, ""));
      b.onclick = function () {
        if (state.hidden.has(key)) state.hidden.delete(key); else state.hidden.add(key);
        draw(element, figure);
        const again = element.querySelectorAll(".legend button")[traces.indexOf(t)];
        if (again) again.focus();
      };
      row.appendChild(b);
    });
    element.appendChild(row);
  }

  function tip(element, hover) {
    const box = document.createElement("div");
    box.className = "tip";
    box.hidden = true;
    element.appendChild(box);
    element.onpointermove = function (e) {
      const b = (element.querySelector(".space") || element.querySelector(".plane")).getBoundingClientRect(), x = e.clientX - b.left, y = e.clientY - b.top;
      let best = null, least = 400;
      hover.forEach(function (h) { const d = (h.at[0] - x) ** 2 + (h.at[1] - y) ** 2; if (d < least) { least = d; best = h; } });
      box.hidden = !best;
      if (!best) return;
      const own = element.getBoundingClientRect();
      box.textContent = best.text;
      box.style.left = Math.min(best.at[0] + 12 + b.left - own.left, own.width - box.offsetWidth - 4) + "px";
      box.style.top = best.at[1] + 10 + b.top - own.top + "px";
    };
    element.onpointerleave = function () { box.hidden = true; };
  }

  /* Draw now.  The element's height is kept, so that a page does not jump. */
  function draw(element, figure) {
    let state = states.get(element);
    if (!state) { state = { hidden: new Set(), zooms: [], space: {} }; states.set(element, state); }
    element.replaceChildren();
    legend(element, figure, state);
    const width = Math.max(240, element.clientWidth), bar = element.firstChild ? element.firstChild.offsetHeight : 0;
    const shown = { layout: figure.layout, data: figure.data.filter(function (t) { return !state.hidden.has(t.legendgroup || t.name); }) };
    const panels = isSolid(figure) ? 1 : tomoposePlane.panelsOf(figure).length;
    const whole = Number(element.dataset.height) || element.clientHeight || 420;
    const stacked = panels > 2 && width < tomoposePlane.NARROW ? 210 * Math.ceil(panels / (width < 380 ? 1 : 2)) : whole;
    element.style.height = (stacked + (stacked === whole ? 0 : bar)) + "px";
    const height = Math.max(160, stacked - (stacked === whole ? bar : 0));
    const again = function () { draw(element, figure); };
    const drawn = isSolid(figure) ? tomoposeSpace.draw(element, shown, width, height, state.space)
      : tomoposePlane.draw(element, shown, width, height, state.zooms, again);
    tip(element, drawn.hover);
    element.dataset.drawn = "yes";
    state.width = element.clientWidth;
    state.figure = figure;
  }

  function redrawAll() {
    document.querySelectorAll(".plot[data-drawn]").forEach(function (e) { draw(e, states.get(e).figure); });
  }

  const resized = window.ResizeObserver ? new ResizeObserver(function (entries) {
    entries.forEach(function (e) {
      const state = states.get(e.target);
      if (state && e.target.clientWidth > 0 && Math.abs(e.target.clientWidth - state.width) > 8) draw(e.target, state.figure);
    });
  }) : null;

  /* Draw figures by the ids of their elements, each when it comes near the window; all of them before printing. */
  function whenSeen(figures) {
    const waiting = new Set(Object.keys(figures));
    const now = function (name) {
      if (!waiting.delete(name)) return;
      draw(document.getElementById(name), figures[name]);
      document.body.dataset.figuresDrawn = String(Object.keys(figures).length - waiting.size);
    };
    document.body.dataset.figuresDrawn = "0";
    const observer = new IntersectionObserver(function (entries) {
      entries.forEach(function (e) { if (e.isIntersecting) { now(e.target.id); observer.unobserve(e.target); } });
    }, { rootMargin: "300px" });
    Object.keys(figures).forEach(function (name) {
      const e = document.getElementById(name);
      observer.observe(e);
      if (resized) resized.observe(e);
    });
    window.addEventListener("beforeprint", function () { Array.from(waiting).forEach(now); redrawAll(); });
    if (window.matchMedia) window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawAll);
    return { all: function () { Array.from(waiting).forEach(now); } };
  }

  return { draw: draw, whenSeen: whenSeen };
})();
