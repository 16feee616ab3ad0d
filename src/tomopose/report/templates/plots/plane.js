"use strict";
/* Plots in the plane as SVG: scatter, bar, heatmap and polar bars, in the vocabulary of plotly.js. */
const tomoposePlane = (function () {
  const N = tomoposeNumbers;
  const SVG = "http://www.w3.org/2000/svg";
  const NARROW = 620;

  function add(parent, tag, attributes, text) {
    const e = document.createElementNS(SVG, tag);
    Object.keys(attributes || {}).forEach(function (k) { e.setAttribute(k, attributes[k]); });
    if (text !== undefined) rich(e, String(text));
    parent.appendChild(e);
    return e;
  }

  /* Text with <sub>index</sub> and <br>, as SVG knows them. */
  function rich(element, text) {
    if (!text.includes("<")) { element.textContent = text; return; }
    const x = element.getAttribute("x") || 0;
    text.split("<br>").forEach(function (line, row) {
      let back = 0;
      line.split(/<sub>|<\/sub>/).forEach(function (part, k) {
        const span = document.createElementNS(SVG, "tspan");
        span.textContent = part;
        if (row && k === 0) { span.setAttribute("x", x); span.setAttribute("dy", "1.25em"); }
        else if (k % 2) { span.setAttribute("dy", "0.3em"); span.setAttribute("font-size", "80%"); back = 1; }
        else if (back) { span.setAttribute("dy", "-0.3em"); back = 0; }
        element.appendChild(span);
      });
    });
  }

  const list = function (v) { return v === undefined || v === null ? [] : Array.isArray(v) ? v : [v]; };
  const titleOf = function (t) { return typeof t === "string" ? t : (t && t.text) || ""; };
  const each = function (v, k) { return Array.isArray(v) ? v[k] : v; };

  /* An axis: its definition, the kind, and how a value becomes a number. */
  function axisOf(layout, id, traces, letter) {
    const name = letter + "axis" + id.slice(1), a = layout[name] || {};
    const values = [].concat(...traces.map(function (t) { return list(t[letter]); }));
    const words = values.some(function (v) { return typeof v === "string"; });
    const kind = a.type || (words ? "category" : "linear");
    const names = kind === "category" ? Array.from(new Set(values.map(String))) : [];
    const number = kind === "category" ? function (v) { return names.indexOf(String(v)); }
      : kind === "date" ? function (v) { return v === null ? null : Date.parse(v); } : function (v) { return v; };
    return { def: a, kind: kind, names: names, number: number, letter: letter };
  }

  function rangeOf(axis, traces, layout) {
    const a = axis.def, letter = axis.letter;
    if (axis.zoom) return axis.zoom;
    if (a.range) return a.range.map(axis.number);
    if (axis.kind === "category") return a.autorange === "reversed" ? [axis.names.length - 0.5, -0.5] : [-0.5, axis.names.length - 0.5];
    let values = [], bars = false;
    traces.forEach(function (t) {
      const own = list(t[letter]).map(axis.number);
      values = values.concat(own);
      if (t.type === "bar" && letter === "y" && axis.kind !== "log") bars = true;
      if (t.type === "bar" && letter === "x" && own.length) {
        const w = each(t.width, 0) || barStep(own);
        values.push(Math.min(...own) - w / 2, Math.max(...own) + w / 2);
      }
      const e = letter === "y" && t.error_y && t.error_y.visible !== false ? list(t.error_y.array) : [];
      e.forEach(function (u, k) { if (own[k] !== null && u !== null) values.push(own[k] + u, own[k] - u); });
    });
    (layout.images || []).forEach(function (p) {
      if (letter === "x") values.push(p.x, p.x + p.sizex); else values.push(p.y, p.y - p.sizey);
    });
    let low, high;
    if (axis.kind === "log") {
      [low, high] = N.extent(values.filter(function (v) { return v > 0; }));
      if (!isFinite(low)) return [1, 10];
      return [low / 1.3, high * 1.3];
    }
    [low, high] = N.extent(values);
    if (!isFinite(low)) return [0, 1];
    if (bars || a.rangemode === "tozero") { low = Math.min(low, 0); high = Math.max(high, 0); }
    const heat = traces.length && traces.every(function (t) { return t.type === "heatmap"; });
    if (heat) {
      const s = list(traces[0][letter]).length > 1 ? (high - low) / (list(traces[0][letter]).length - 1) : 1;
      return a.autorange === "reversed" ? [high + s / 2, low - s / 2] : [low - s / 2, high + s / 2];
    }
    const pad = high > low ? 0.05 * (high - low) : Math.abs(high) * 0.05 || 1;
    const out = [low === 0 && (bars || a.rangemode === "tozero") ? 0 : low - pad, high === 0 && bars ? 0 : high + pad];
    return a.autorange === "reversed" ? out.reverse() : out;
  }

  function barStep(values) {
    const sorted = Array.from(new Set(values)).sort(function (a, b) { return a - b; });
    const gaps = sorted.slice(1).map(function (v, k) { return v - sorted[k]; });
    return gaps.length ? Math.min(...gaps) : 1;
  }

  /* The panels of a figure: traces that share a pair of axes; y2 overlays its panel. */
  function panelsOf(figure) {
    const found = new Map();
    figure.data.forEach(function (t) {
      const x = t.xaxis || "x", y = t.yaxis || "y", a = figure.layout["yaxis" + y.slice(1)] || {};
      const key = x + (a.overlaying || y);
      if (!found.has(key)) found.set(key, { x: x, y: a.overlaying || y, traces: [], right: [], rightId: null });
      const panel = found.get(key);
      if (a.overlaying) { panel.right.push(t); panel.rightId = y; } else panel.traces.push(t);
    });
    return Array.from(found.values());
  }

  function place(panel, figure, width, height, count, index, box) {
    if (count > 2 && width < NARROW) {
      const columns = width < 380 ? 1 : 2, rows = Math.ceil(count / columns), gap = 52;
      const w = (width - box.l - box.r - (columns - 1) * gap) / columns, h = (height - box.t - rows * 48) / rows;
      return { x: box.l + (index % columns) * (w + gap), y: box.t + Math.floor(index / columns) * (h + 48), w: w, h: h, alone: true };
    }
    const dx = (figure.layout["xaxis" + panel.x.slice(1)] || {}).domain || [0, 1];
    const dy = (figure.layout["yaxis" + panel.y.slice(1)] || {}).domain || [0, 1];
    const w = width - box.l - box.r, h = height - box.t - box.b;
    return { x: box.l + dx[0] * w, y: box.t + (1 - dy[1]) * h, w: (dx[1] - dx[0]) * w, h: (dy[1] - dy[0]) * h, alone: false };
  }

  function scaleOf(axis, range, from, to) {
    const f = axis.kind === "log" ? Math.log10 : function (v) { return v; };
    const a = f(range[0]), b = f(range[1]);
    const map = function (v) { return from + (f(v) - a) / (b - a || 1) * (to - from); };
    map.back = function (p) { const g = a + (p - from) / (to - from) * (b - a); return axis.kind === "log" ? Math.pow(10, g) : g; };
    return map;
  }

  function drawAxis(g, axis, range, map, area, side) {
    const low = Math.min(...range), high = Math.max(...range), a = axis.def;
    if (a.visible === false) return;
    const across = side === "bottom", length = across ? area.w : area.h;
    const count = Math.max(2, Math.min(a.nticks || 9, Math.floor(length / (across ? 62 : 34))));
    let t = axis.kind === "log" ? N.logTicks(low, high) : axis.kind === "date" ? N.dateTicks(low, high, count)
      : axis.kind === "category" ? { at: axis.names.map(function (_, k) { return k; }), labels: axis.names, note: "" } : N.ticks(low, high, count);
    if (typeof a.dtick === "number" && axis.kind === "linear" && (high - low) / a.dtick <= 16) {
      t = N.ticks(low, high, (high - low) / a.dtick);
    }
    const longest = Math.max(0, ...t.labels.map(function (s) { return String(s).replace(/<[^>]*>/g, "").length; }));
    const turned = across && axis.kind === "category" && longest * 6.8 > length / Math.max(1, t.labels.length);
    const every = axis.kind === "category" ? Math.ceil(t.at.length * (turned || !across ? 13 : 1) / length) || 1 : 1;
    t.at.forEach(function (v, k) {
      const p = map(v);
      if (a.showgrid !== false && axis.kind !== "category" && side !== "right") {
        add(g, "path", { class: v === 0 ? "zero" : "grid", d: across ? "M" + p + "," + area.y + "v" + area.h : "M" + area.x + "," + p + "h" + area.w });
      }
      if (a.showticklabels === false && !area.alone || k % every) return;
      if (across) {
        const y = area.y + area.h + 16;
        add(g, "text", turned ? { class: "tick", x: p, y: y - 4, "text-anchor": "end", transform: "rotate(-40 " + p + " " + (y - 4) + ")" }
          : { class: "tick", x: p, y: y, "text-anchor": "middle" }, t.labels[k]);
      } else {
        add(g, "text", { class: "tick", x: side === "right" ? area.x + area.w + 7 : area.x - 7, y: p + 4, "text-anchor": side === "right" ? "start" : "end" }, t.labels[k]);
      }
    });
    add(g, "path", { class: "axis", d: across ? "M" + area.x + "," + (area.y + area.h) + "h" + area.w
      : "M" + (side === "right" ? area.x + area.w : area.x) + "," + area.y + "v" + area.h });
    const title = titleOf(a.title) + t.note;
    if (!title.trim()) return;
    if (across) add(g, "text", { class: "title", x: area.x + area.w / 2, y: area.y + area.h + (turned ? 58 : 34), "text-anchor": "middle" }, title);
    else {
      const x = side === "right" ? area.x + area.w + 46 : area.x - 46, y = area.y + area.h / 2;
      add(g, "text", { class: "title", x: x, y: y, "text-anchor": "middle", transform: "rotate(-90 " + x + " " + y + ")" }, title);
    }
  }

  const SYMBOLS = { "x-thin": "M-1,-1L1,1M-1,1L1,-1", "cross-thin": "M0,-1V1M-1,0H1", diamond: "M0,-1.2L1.2,0L0,1.2L-1.2,0Z" };
  const DASHES = { dash: "7 5", dot: "2 4", dashdot: "7 4 2 4" };

  function drawScatter(g, t, X, Y, hover) {
    const mode = t.mode || "lines", line = t.line || {}, m = t.marker || {}, xs = list(t.x), ys = list(t.y);
    const at = xs.map(function (x, k) {
      const a = X.axis.number(x), b = Y.axis.number(ys[k]);
      return a === null || b === null || b === undefined || !isFinite(a) || !isFinite(b) ? null : [X.map(a), Y.map(b)];
    });
    if (mode.includes("lines")) {
      let d = "", pen = false;
      at.forEach(function (p, k) {
        if (!p) { pen = false; return; }
        const q = pen && at[k - 1];
        if (!pen) d += "M" + p[0].toFixed(1) + "," + p[1].toFixed(1);
        else if (line.shape === "hvh") d += "H" + ((p[0] + q[0]) / 2).toFixed(1) + "V" + p[1].toFixed(1) + "H" + p[0].toFixed(1);
        else d += "L" + p[0].toFixed(1) + "," + p[1].toFixed(1);
        pen = true;
      });
      const closed = t.fill === "toself";
      add(g, "path", { class: "line", d: d, fill: closed ? N.ink(t.fillcolor || line.color) : "none", stroke: N.ink(line.color || "#1f5f99"),
        "stroke-width": line.width || 2, "stroke-dasharray": DASHES[line.dash] || "none", opacity: t.opacity || 1 });
    }
    const e = t.error_y && t.error_y.visible !== false ? t.error_y : null;
    if (e) errorBars(g, e, ys.map(Y.axis.number), at, Y, N.ink(e.color || m.color || "#1d2733"));
    const colours = Array.isArray(m.color) && typeof m.color[0] === "number" ? scaled(m) : null;
    at.forEach(function (p, k) {
      if (!p) return;
      if (mode.includes("markers")) {
        const colour = colours ? colours(m.color[k]) : each(m.color, k) || "#1f5f99", r = (each(m.size, k) || 6) / 2;
        const edge = m.line || {}, symbol = SYMBOLS[m.symbol];
        if (symbol) add(g, "path", { class: "point", d: symbol, transform: "translate(" + p[0].toFixed(1) + "," + p[1].toFixed(1) + ") scale(" + r + ")",
          fill: m.symbol.includes("thin") ? "none" : N.ink(colour), stroke: N.ink(each(edge.color, k) || colour), "stroke-width": (edge.width || 1.5) / r });
        else add(g, "circle", { class: "point", cx: p[0].toFixed(1), cy: p[1].toFixed(1), r: r, fill: N.ink(colour), opacity: m.opacity || 1,
          stroke: edge.width ? N.ink(each(edge.color, k) || colour) : "none", "stroke-width": edge.width || 0 });
      }
      if (mode.includes("text") && each(t.text, k)) {
        const where = t.textposition || "top center", font = t.textfont || {};
        add(g, "text", { class: "note", x: p[0] + (where.includes("right") ? 6 : where.includes("left") ? -6 : 0), y: p[1] + (where.includes("top") ? -7 : where.includes("bottom") ? 16 : 4),
          "text-anchor": where.includes("right") ? "start" : where.includes("left") ? "end" : "middle", fill: N.ink(each(font.color, k) || "#1d2733") }, each(t.text, k));
      }
      if (t.hoverinfo !== "skip") hover.push({ at: p, text: hoverText(t, k, xs[k], ys[k]) });
    });
  }

  function hoverText(t, k, x, y, z) {
    const point = { x: x, y: y, z: z, text: each(t.text, k), customdata: each(t.customdata, k), "marker.color": each((t.marker || {}).color, k), theta: x, r: y };
    return N.fill(t.hovertemplate || (t.name ? t.name + "<br>" : "") + "%{x:.5~g}, %{y:.5~g}", point);
  }

  function scaled(m) {
    const range = N.extent(m.color), low = m.cmin === undefined ? range[0] : m.cmin, high = m.cmax === undefined ? range[1] : m.cmax;
    return function (v) { return N.onScale(m.colorscale || N.DEFAULT_SCALE, (v - low) / (high - low || 1)); };
  }

  function errorBars(g, e, ys, at, Y, colour) {
    list(e.array).forEach(function (u, k) {
      if (!at[k] || !(u > 0)) return;
      const a = Y.map(ys[k] - u), b = Y.map(ys[k] + u), x = at[k][0];
      add(g, "path", { class: "bar-of-error", d: "M" + x + "," + a + "V" + b + "M" + (x - 3) + "," + a + "h6M" + (x - 3) + "," + b + "h6", stroke: colour, "stroke-width": e.thickness || 1.2, fill: "none" });
    });
  }

  function drawBar(g, t, X, Y, hover, k, n, layout) {
    const xs = list(t.x), ys = list(t.y), gap = layout.bargap === undefined ? 0.2 : layout.bargap;
    const own = xs.map(X.axis.number), whole = each(t.width, 0) || barStep(own) * (1 - gap);
    const w = whole / n, base = Y.axis.kind === "log" ? Math.min(...Y.range) : 0;
    const at = own.map(function (x, i) {
      const y = ys[i];
      if (y === null || y === undefined || !isFinite(y)) return null;
      const left = x - whole / 2 + k * w, a = X.map(left), b = X.map(left + w), top = Y.map(y), foot = Y.map(base);
      const m = t.marker || {};
      add(g, "rect", { class: "bar", x: Math.min(a, b), width: Math.max(1, Math.abs(b - a) - (gap ? 1 : 0)), y: Math.min(top, foot), height: Math.max(0.5, Math.abs(foot - top)),
        fill: N.ink(each(m.color, i) || "#1f5f99"), stroke: m.line && m.line.width ? N.ink(m.line.color) : "none", "stroke-width": (m.line || {}).width || 0 });
      if (t.hoverinfo !== "skip") hover.push({ at: [(a + b) / 2, top], text: (t.name && n > 1 ? t.name + "\n" : "") + hoverText(t, i, xs[i], y) });
      return [(a + b) / 2, top];
    });
    if (t.error_y && t.error_y.visible !== false) errorBars(g, t.error_y, ys, at, Y, N.ink("#1d2733"));
  }

  function drawHeatmap(g, t, X, Y, hover) {
    const rows = t.z, n = rows.length, m = n ? rows[0].length : 0;
    const flat = [].concat(...rows), range = N.extent(flat);
    const low = t.zmin === undefined ? range[0] : t.zmin, high = t.zmax === undefined ? range[1] : t.zmax;
    const xs = t.x ? list(t.x).map(X.axis.number) : rows[0].map(function (_, i) { return i; });
    const ys = t.y ? list(t.y).map(Y.axis.number) : rows.map(function (_, i) { return i; });
    const w = Math.abs(X.map(xs[0] + barStep(xs)) - X.map(xs[0])), h = Math.abs(Y.map(ys[0] + barStep(ys)) - Y.map(ys[0]));
    const gap = t.xgap || 0, scale = t.colorscale || N.DEFAULT_SCALE, words = /%\{z:(\.\d+f)\}/.exec(t.texttemplate || "");
    for (let i = 0; i < n; i++) for (let k = 0; k < m; k++) {
      const v = rows[i][k];
      if (v === null || v === undefined) continue;
      const x = X.map(xs[k]), y = Y.map(ys[i]), s = (v - low) / (high - low || 1);
      add(g, "rect", { class: "cell", x: (x - w / 2).toFixed(1), y: (y - h / 2).toFixed(1), width: Math.max(0.5, w - gap).toFixed(2), height: Math.max(0.5, h - gap).toFixed(2), fill: N.onScale(scale, s) });
      if (words && w > 24 && h > 11) add(g, "text", { class: "value", x: x, y: y + 3.5, "text-anchor": "middle", fill: s < 0.22 || s > 0.8 ? "#ffffff" : "#1d2733" }, N.fill("%{z:" + words[1] + "}", { z: v }));
      hover.push({ at: [x, y], text: hoverText(t, k, list(t.x)[k], list(t.y)[i], v) });
    }
  }

  function colourBar(svg, bar, scale, low, high, x, y, h) {
    const id = "scale-" + Math.random().toString(36).slice(2);
    const gradient = add(add(svg, "defs"), "linearGradient", { id: id, x1: 0, y1: 1, x2: 0, y2: 0 });
    scale.forEach(function (p) { add(gradient, "stop", { offset: p[0], "stop-color": p[1] }); });
    add(svg, "rect", { x: x, y: y, width: 12, height: h, fill: "url(#" + id + ")" });
    const t = N.ticks(low, high, 4);
    t.at.forEach(function (v, k) { add(svg, "text", { class: "tick", x: x + 17, y: y + h - (v - low) / (high - low || 1) * h + 4 }, t.labels[k]); });
    add(svg, "text", { class: "title", x: x + 58, y: y - 8, "text-anchor": "end" }, titleOf((bar || {}).title) + t.note);
  }

  function drawPolar(svg, t, width, height, hover) {
    const R = Math.min(width, height) / 2 - 34, cx = width / 2, cy = height / 2, most = Math.max(...list(t.r), 1);
    const s = N.ticks(0, most, 3);
    s.at.forEach(function (v, k) {
      add(svg, "circle", { class: "grid round", cx: cx, cy: cy, r: R * v / most });
      if (v > 0) add(svg, "text", { class: "tick", x: cx + R * v / most * Math.cos(-0.38) + 2, y: cy + R * v / most * Math.sin(-0.38) }, s.labels[k]);
    });
    for (let a = 0; a < 360; a += 45) {
      const c = Math.cos(a * Math.PI / 180), d = -Math.sin(a * Math.PI / 180);
      add(svg, "path", { class: "grid", d: "M" + cx + "," + cy + "L" + (cx + R * c) + "," + (cy + R * d) });
      add(svg, "text", { class: "tick", x: cx + (R + 16) * c, y: cy + (R + 16) * d + 4, "text-anchor": "middle" }, a + "°");
    }
    list(t.theta).forEach(function (a, k) {
      const r = R * t.r[k] / most, half = (each(t.width, k) || 9) / 2;
      const p = [a - half, a + half].map(function (x) { return [cx + r * Math.cos(x * Math.PI / 180), cy - r * Math.sin(x * Math.PI / 180)]; });
      add(svg, "path", { class: "bar", fill: N.ink((t.marker || {}).color || "#1f5f99"), d: "M" + cx + "," + cy + "L" + p[0] + "A" + r + "," + r + " 0 0 0 " + p[1] + "Z" });
      hover.push({ at: [(p[0][0] + p[1][0]) / 2, (p[0][1] + p[1][1]) / 2], text: N.fill(t.hovertemplate || "%{theta}: %{r}", { theta: a, r: t.r[k] }) });
    });
  }

  function margins(figure, panels, width) {
    const first = panels[0] || {}, y = figure.layout["yaxis" + (first.y || "y").slice(1)] || {}, x = figure.layout["xaxis" + (first.x || "x").slice(1)] || {};
    const words = [].concat(...(first.traces || []).map(function (t) { return t.type === "heatmap" || x.type === "category" ? list(t.x) : []; }))
      .filter(function (v) { return typeof v === "string"; }).map(function (v) { return v.replace(/<[^>]*>/g, ""); });
    const rows = [].concat(...(first.traces || []).map(function (t) { return list(t.y); })).filter(function (v) { return typeof v === "string"; });
    const longest = Math.max(0, ...words.map(function (v) { return v.length; }));
    const crowded = longest * 6.8 * new Set(words).size > width - 90;
    const bar = figure.data.some(hasBar);
    const bare = y.visible === false;
    return { t: 14, r: panels.some(function (p) { return p.rightId; }) ? 62 : bar ? 84 : 16, b: x.visible === false ? 8 : crowded ? 30 + Math.min(70, longest * 4.6) : 44,
      l: bare ? 6 : rows.length ? 20 + 7 * Math.min(16, Math.max(...rows.map(function (v) { return v.replace(/<[^>]*>/g, "").length; }))) : 62 };
  }

  function hasBar(t) { return (t.type === "heatmap" && t.showscale !== false) || (t.marker && t.marker.showscale) || (t.marker && t.marker.colorbar); }

  /* Draw a figure without a third dimension into an element of that width and height; returns the places that hover. */
  function draw(element, figure, width, height, zooms, redraw) {
    const svg = add(element, "svg", { width: width, height: height, viewBox: "0 0 " + width + " " + height, class: "plane", "aria-hidden": "true" });
    const hover = [];
    if (figure.data.some(function (t) { return t.type === "barpolar"; })) {
      drawPolar(svg, figure.data[0], width, height, hover);
      return { svg: svg, hover: hover };
    }
    const panels = panelsOf(figure), box = margins(figure, panels, width);
    panels.forEach(function (panel, index) { drawPanel(svg, figure, panel, index, panels.length, width, height, box, hover, zooms, redraw); });
    const barred = figure.data.find(hasBar);
    if (barred) {
      const m = barred.type === "heatmap" ? barred : barred.marker;
      const values = barred.type === "heatmap" ? [].concat(...barred.z) : m.color, range = N.extent(values.filter(function (v) { return typeof v === "number"; }));
      const low = barred.zmin !== undefined ? barred.zmin : m.cmin !== undefined ? m.cmin : range[0], high = barred.zmax !== undefined ? barred.zmax : m.cmax !== undefined ? m.cmax : range[1];
      colourBar(svg, m.colorbar, m.colorscale || N.DEFAULT_SCALE, low, high, width - 64, box.t + 24, Math.max(60, height - box.t - box.b - 34));
    }
    return { svg: svg, hover: hover };
  }

  function drawPanel(svg, figure, panel, index, count, width, height, box, hover, zooms, redraw) {
    const layout = figure.layout, all = panel.traces.concat(panel.right);
    const xAxis = axisOf(layout, panel.x, all, "x"), yAxis = axisOf(layout, panel.y, panel.traces, "y");
    const zoom = zooms[index] || {};
    xAxis.zoom = zoom.x; yAxis.zoom = zoom.y;
    let area = place(panel, figure, width, height, count, index, box);
    const xr = rangeOf(xAxis, all, layout), yr = rangeOf(yAxis, panel.traces, layout);
    if (yAxis.def.scaleanchor && !zoom.x) {
      const s = Math.min(area.w / Math.abs(xr[1] - xr[0]), area.h / Math.abs(yr[1] - yr[0]) / (yAxis.def.scaleratio || 1));
      const w = s * Math.abs(xr[1] - xr[0]), h = s * Math.abs(yr[1] - yr[0]) * (yAxis.def.scaleratio || 1);
      area = { x: area.x + (area.w - w) / 2, y: area.y + (area.h - h) / 2, w: w, h: h, alone: area.alone };
    }
    const X = { axis: xAxis, range: xr, map: scaleOf(xAxis, xr, area.x, area.x + area.w) };
    const Y = { axis: yAxis, range: yr, map: scaleOf(yAxis, yr, area.y + area.h, area.y) };
    const g = add(svg, "g");
    add(g, "rect", { class: "ground", x: area.x, y: area.y, width: area.w, height: area.h });
    (layout.images || []).forEach(function (p) {
      const x = X.map(p.x), y = Y.map(p.y);
      add(g, "image", { href: p.source, x: x, y: y, width: Math.abs(X.map(p.x + p.sizex) - x), height: Math.abs(Y.map(p.y - p.sizey) - y), preserveAspectRatio: "none" });
    });
    drawAxis(g, xAxis, xr, X.map, area, "bottom");
    drawAxis(g, yAxis, yr, Y.map, area, "left");
    const clip = "clip-" + Math.random().toString(36).slice(2);
    add(add(add(svg, "defs"), "clipPath", { id: clip }), "rect", { x: area.x - 4, y: area.y - 8, width: area.w + 8, height: area.h + 12 });
    const marks = add(g, "g", { "clip-path": "url(#" + clip + ")" });
    const bars = panel.traces.filter(function (t) { return t.type === "bar"; });
    panel.traces.forEach(function (t) {
      if (t.type === "bar") drawBar(marks, t, X, Y, hover, layout.barmode === "overlay" ? 0 : bars.indexOf(t), layout.barmode === "overlay" ? 1 : bars.length, layout);
      else if (t.type === "heatmap") drawHeatmap(marks, t, X, Y, hover);
      else drawScatter(marks, t, X, Y, hover);
    });
    if (panel.right.length) {
      const second = axisOf(layout, panel.rightId, panel.right, "y"), range = rangeOf(second, panel.right, layout);
      const R = { axis: second, range: range, map: scaleOf(second, range, area.y + area.h, area.y) };
      drawAxis(g, second, range, R.map, area, "right");
      panel.right.forEach(function (t) { drawScatter(marks, t, X, R, hover); });
    }
    (layout.annotations || []).forEach(function (a) {
      const x = a.xref === "paper" ? area.x + a.x * area.w : X.map(a.x), y = a.yref === "paper" ? area.y + (1 - a.y) * area.h : Y.map(a.y);
      add(g, "text", { class: "note", x: x, y: y, "text-anchor": a.xanchor === "left" ? "start" : a.xanchor === "right" ? "end" : "middle",
        fill: N.ink((a.font || {}).color || "#5b6775") }, a.text);
    });
    boxZoom(svg, area, X, Y, function (z) { zooms[index] = z; redraw(); });
  }

  /* Dragging a box enlarges it; a double click shows everything again. */
  function boxZoom(svg, area, X, Y, zoomed) {
    if (X.axis.kind === "category" || Y.axis.kind === "category") return;
    const inside = function (e) {
      const b = svg.getBoundingClientRect(), x = e.clientX - b.left, y = e.clientY - b.top;
      return x >= area.x && x <= area.x + area.w && y >= area.y && y <= area.y + area.h ? [x, y] : null;
    };
    let from = null, shown = null;
    svg.addEventListener("pointerdown", function (e) { if (e.pointerType === "mouse") from = inside(e); });
    svg.addEventListener("pointermove", function (e) {
      const to = from && inside(e);
      if (!to) return;
      if (!shown) shown = add(svg, "rect", { class: "zoom" });
      const b = { x: Math.min(from[0], to[0]), y: Math.min(from[1], to[1]), width: Math.abs(to[0] - from[0]), height: Math.abs(to[1] - from[1]) };
      Object.keys(b).forEach(function (k) { shown.setAttribute(k, b[k]); });
    });
    svg.addEventListener("pointerup", function (e) {
      const to = from && inside(e), a = from;
      from = null;
      if (shown) { shown.remove(); shown = null; }
      if (!to || Math.abs(to[0] - a[0]) < 8 || Math.abs(to[1] - a[1]) < 8) return;
      zoomed({ x: [Math.min(a[0], to[0]), Math.max(a[0], to[0])].map(X.map.back), y: [Math.max(a[1], to[1]), Math.min(a[1], to[1])].map(Y.map.back) });
    });
    svg.addEventListener("dblclick", function (e) { if (inside(e)) zoomed(undefined); });
  }

  return { draw: draw, add: add, colourBar: colourBar, hoverText: hoverText, scaled: scaled, NARROW: NARROW, panelsOf: panelsOf };
})();
