"use strict";
/* Scenes in space on a canvas: lines, points, words and triangles; turned by dragging or by the arrow keys. */
const tomoposeSpace = (function () {
  const N = tomoposeNumbers;
  const MOVING = 12000; /* triangles that are drawn while a scene turns; all of them when it rests */
  const each = function (v, k) { return Array.isArray(v) ? v[k] : v; };

  function bounds(data) {
    return ["x", "y", "z"].map(function (a) { return N.extent([].concat(...data.map(function (t) { return t[a] || []; }))); });
  }

  /* Longest side becomes 1; "manual" scenes bring their own proportions. */
  function proportions(scene, box) {
    const span = box.map(function (b) { return b[1] - b[0] || 1; }), longest = Math.max(...span);
    if (scene.aspectmode === "manual" && scene.aspectratio) {
      const r = scene.aspectratio, most = Math.max(r.x, r.y, r.z);
      return [r.x, r.y, r.z].map(function (q, k) { return q / most / span[k]; });
    }
    return span.map(function () { return 1 / longest; });
  }

  function viewOf(scene) {
    const eye = (scene.camera || {}).eye || { x: 1.25, y: 1.25, z: 1.0 };
    return { azimuth: Math.atan2(eye.y, eye.x), elevation: Math.atan2(eye.z, Math.hypot(eye.x, eye.y)), zoom: 1 };
  }

  function projection(view, scene, box, width, height) {
    const f = proportions(scene, box), mid = box.map(function (b) { return (b[0] + b[1]) / 2; });
    const a = view.azimuth, e = view.elevation, ca = Math.cos(a), sa = Math.sin(a), ce = Math.cos(e), se = Math.sin(e);
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map(function (c) { return box.map(function (b, k) { return b[(c >> k) & 1]; }); });
    const turn = function (p) {
      const x = (p[0] - mid[0]) * f[0], y = (p[1] - mid[1]) * f[1], z = (p[2] - mid[2]) * f[2];
      return [-sa * x + ca * y, -se * ca * x - se * sa * y + ce * z, ce * ca * x + ce * sa * y + se * z];
    };
    const seen = corners.map(turn), reach = [0, 1].map(function (k) { return Math.max(...seen.map(function (p) { return Math.abs(p[k]); })); });
    const s = view.zoom * Math.min((width - 150) / 2 / (reach[0] || 1), (height - 70) / 2 / (reach[1] || 1));
    const map = function (p) { const q = turn(p); return [width / 2 - (scene.barred ? 30 : -14) + s * q[0], height / 2 - s * q[1], q[2]]; };
    map.corners = corners;
    return map;
  }

  function ground(c, map, scene, box, inks) {
    const nearest = map.corners.map(function (p, k) { return [map(p)[2], k]; }).sort(function (a, b) { return a[0] - b[0]; })[0][1];
    c.strokeStyle = inks.line; c.lineWidth = 1; c.font = "11px sans-serif";
    /* The three faces behind: all edges that begin at the farthest corner's neighbours. */
    for (let i = 0; i < 8; i++) for (let k = 0; k < 3; k++) {
      const j = i ^ (1 << k);
      if (j < i || (i !== nearest && j !== nearest && ((i ^ nearest) & (j ^ nearest)) === 0)) continue;
      if ((7 ^ nearest) === i || (7 ^ nearest) === j) continue;
      const p = map(map.corners[i]), q = map(map.corners[j]);
      c.beginPath(); c.moveTo(p[0], p[1]); c.lineTo(q[0], q[1]); c.stroke();
    }
    ["xaxis", "yaxis", "zaxis"].forEach(function (name, k) { axisTicks(c, map, scene[name] || {}, box, k, nearest, inks); });
  }

  /* Ticks along an edge of the box that lies on its outline. */
  function axisTicks(c, map, axis, box, k, nearest, inks) {
    const others = [0, 1, 2].filter(function (j) { return j !== k; });
    let best = null;
    for (let m = 0; m < 4; m++) {
      const p = [0, 0, 0];
      others.forEach(function (j, n) { p[j] = box[j][(m >> n) & 1]; });
      const a = p.slice(), b = p.slice(); a[k] = box[k][0]; b[k] = box[k][1];
      const A = map(a), B = map(b), y = k === 2 ? -Math.min(A[0], B[0]) : A[1] + B[1];
      if (!best || y > best.y) best = { y: y, a: a, b: b, A: A, B: B };
    }
    const length = Math.hypot(best.A[0] - best.B[0], best.A[1] - best.B[1]);
    if (length < 36) return;
    const t = N.ticks(box[k][0], box[k][1], Math.min(axis.nticks || 4, Math.floor(length / 44)));
    const down = k === 2 ? [-8, 3] : [best.B[0] + best.A[0] > 2 * map(mid(box))[0] ? 6 : -6, 14];
    c.fillStyle = inks.soft; c.textAlign = k === 2 ? "right" : down[0] > 0 ? "left" : "right";
    t.at.forEach(function (v, n) {
      const p = best.a.slice(); p[k] = v;
      const q = map(p);
      c.fillText(t.labels[n], q[0] + down[0], q[1] + down[1]);
    });
    c.fillStyle = inks.ink;
    const title = ((axis.title || {}).text || "") + t.note, x = (best.A[0] + best.B[0]) / 2, y = (best.A[1] + best.B[1]) / 2;
    c.textAlign = k === 2 ? "right" : down[0] > 0 ? "left" : "right";
    c.fillText(title, x + (k === 2 ? -34 : 4 * down[0]), y + (k === 2 ? 0 : 2.1 * down[1]));
  }

  function mid(box) { return box.map(function (b) { return (b[0] + b[1]) / 2; }); }

  function triangles(c, t, map, moving) {
    const at = t.x.map(function (x, k) { return map([x, t.y[k], t.z[k]]); });
    const stride = moving ? Math.max(1, Math.ceil(t.i.length / MOVING)) : 1, order = [];
    for (let f = 0; f < t.i.length; f += stride) order.push(f);
    order.sort(function (a, b) { return at[t.i[a]][2] + at[t.j[a]][2] + at[t.k[a]][2] - at[t.i[b]][2] - at[t.j[b]][2] - at[t.k[b]][2]; });
    const scale = t.colorscale || N.DEFAULT_SCALE, low = t.cmin, high = t.cmax;
    c.globalAlpha = t.opacity || 1;
    order.forEach(function (f) {
      const p = [t.i[f], t.j[f], t.k[f]];
      let colour = N.ink(t.color || "#9dbfdd");
      if (t.intensity) {
        const v = p.map(function (n) { return t.intensity[n]; }).filter(function (x) { return x !== null; });
        colour = v.length ? N.onScale(scale, (v.reduce(function (a, b) { return a + b; }, 0) / v.length - low) / (high - low || 1)) : "#969696";
      }
      c.fillStyle = colour; c.strokeStyle = colour; c.lineWidth = t.intensity ? 0.6 : 0;
      c.beginPath(); c.moveTo(at[p[0]][0], at[p[0]][1]); c.lineTo(at[p[1]][0], at[p[1]][1]); c.lineTo(at[p[2]][0], at[p[2]][1]); c.closePath(); c.fill();
      if (t.intensity) c.stroke();
    });
    c.globalAlpha = 1;
  }

  function lines(c, t, map, hover) {
    const mode = t.mode || "lines+markers", m = t.marker || {}, line = t.line || {};
    const at = t.x.map(function (x, k) { return x === null ? null : map([x, t.y[k], t.z[k]]); });
    if (mode.includes("lines")) {
      c.strokeStyle = N.ink(line.color || "#1f5f99"); c.lineWidth = Math.min(line.width || 2, 3); c.setLineDash(line.dash === "dash" ? [6, 5] : []);
      c.beginPath();
      let pen = false;
      at.forEach(function (p) { if (!p) { pen = false; return; } if (pen) c.lineTo(p[0], p[1]); else c.moveTo(p[0], p[1]); pen = true; });
      c.stroke(); c.setLineDash([]);
    }
    const colours = Array.isArray(m.color) && typeof m.color[0] === "number" ? tomoposePlane.scaled(m) : null;
    at.forEach(function (p, k) {
      if (!p) return;
      if (mode.includes("markers")) {
        c.fillStyle = N.ink(colours ? colours(m.color[k]) : each(m.color, k) || "#1f5f99");
        c.beginPath(); c.arc(p[0], p[1], (each(m.size, k) || 5) / 1.6, 0, 7); c.fill();
      }
      const word = mode.includes("text") && each(t.text, k);
      if (word) {
        c.fillStyle = N.ink(each((t.textfont || {}).color, k) || "#1d2733"); c.textAlign = "left"; c.font = "12px sans-serif";
        c.fillText(String(word).replace(/<[^>]*>/g, ""), p[0] + 5, p[1] - 4);
      }
      if (t.hoverinfo !== "skip") hover.push({ at: p, text: tomoposePlane.hoverText(t, k, t.x[k], t.y[k], t.z[k]) });
    });
  }

  function hasBar(t) { return (t.type === "mesh3d" && t.intensity) || (t.marker && t.marker.showscale); }

  function paint(canvas, figure, view, hover, moving) {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight, c = canvas.getContext("2d");
    canvas.width = width * ratio; canvas.height = height * ratio;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    const style = getComputedStyle(canvas), inks = { ink: style.getPropertyValue("--ink"), soft: style.getPropertyValue("--soft"), line: style.getPropertyValue("--line") };
    const barred = figure.data.some(hasBar), scene = Object.assign({ barred: barred }, figure.layout.scene), data = figure.data.filter(function (t) { return t.visible !== false; }), box = bounds(data);
    if (!box.every(function (b) { return isFinite(b[0]); })) return;
    const map = projection(view, scene, box, width, height);
    hover.length = 0;
    ground(c, map, scene, box, inks);
    data.filter(function (t) { return t.type === "mesh3d"; }).forEach(function (t) { triangles(c, t, map, moving); });
    data.filter(function (t) { return t.type === "scatter3d"; }).forEach(function (t) { lines(c, t, map, hover); });
  }

  /* Draw a figure of scatter3d and mesh3d traces; the element's own view is kept between drawings. */
  function draw(element, figure, width, height, state) {
    const canvas = document.createElement("canvas"), hover = [];
    canvas.className = "space";
    canvas.style.width = width + "px"; canvas.style.height = height + "px";
    element.appendChild(canvas);
    const view = state.view || (state.view = viewOf(figure.layout.scene || {}));
    const again = function (moving) { paint(canvas, figure, view, hover, moving); };
    let from = null;
    canvas.addEventListener("pointerdown", function (e) { from = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointermove", function (e) {
      if (!from) return;
      view.azimuth -= (e.clientX - from[0]) * 0.008;
      view.elevation = Math.max(-1.57, Math.min(1.57, view.elevation + (e.clientY - from[1]) * 0.008));
      from = [e.clientX, e.clientY];
      again(true);
    });
    canvas.addEventListener("pointerup", function () { from = null; again(false); });
    canvas.addEventListener("wheel", function (e) {
      if (!e.ctrlKey && document.activeElement !== element) return; /* the page scrolls past a scene that nobody chose */
      e.preventDefault(); view.zoom *= Math.exp(-e.deltaY * 0.001); again(false);
    }, { passive: false });
    element.onkeydown = function (e) {
      const step = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
      if (step) { view.azimuth += step[0]; view.elevation = Math.max(-1.57, Math.min(1.57, view.elevation + step[1])); }
      else if (e.key === "+" || e.key === "=") view.zoom *= 1.15;
      else if (e.key === "-") view.zoom /= 1.15;
      else return;
      e.preventDefault(); e.stopPropagation();
      again(false);
    };
    again(false);
    const barred = figure.data.find(hasBar);
    if (barred) {
      const m = barred.intensity ? barred : barred.marker, range = N.extent(barred.intensity ? barred.intensity : m.color);
      const svg = tomoposePlane.add(element, "svg", { class: "plane over", width: width, height: height, "aria-hidden": "true" });
      tomoposePlane.colourBar(svg, m.colorbar, m.colorscale || N.DEFAULT_SCALE, m.cmin === undefined ? range[0] : m.cmin, m.cmax === undefined ? range[1] : m.cmax, width - 64, 34, Math.min(260, height - 70));
    }
    return { canvas: canvas, hover: hover };
  }

  return { draw: draw };
})();
