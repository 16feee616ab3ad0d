"use strict";
/* Numbers and colours of plots: ticks of at most four digits, formats of hover texts, colour scales. */
const tomoposeNumbers = (function () {
  const MOST_DIGITS = 4;

  /* The smallest of 1, 2, 5 times a power of ten that is not below x. */
  function step(x) {
    const power = Math.pow(10, Math.floor(Math.log10(x)));
    return [1, 2, 5, 10].map(function (m) { return m * power; }).find(function (s) { return s >= x * (1 - 1e-9); });
  }

  function decimalsOf(s) {
    return Math.max(0, Math.min(12, -Math.floor(Math.log10(s) + 1e-9)));
  }

  function minus(text) { return text.replace("-", "−"); }

  function digits(text) { return text.replace(/[^0-9]/g, "").length; }

  function superscript(n) {
    return String(n).replace(/[-0-9]/g, function (c) { return "-0123456789".includes(c) ? "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)] : c; });
  }

  /* Ticks of a linear axis: places, labels of at most four digits, and what the title must say besides. */
  function ticks(low, high, count) {
    const span = high - low;
    if (!(span > 0) || !isFinite(span)) return { at: [low], labels: [minus(significant(low, MOST_DIGITS))], note: "" };
    const s = step(span / Math.max(count, 1));
    const at = [];
    for (let k = Math.ceil(low / s - 1e-9); k * s <= high + 1e-9 * span; k++) at.push(k * s === 0 ? 0 : k * s);
    const labelled = function (values, unit) {
      const d = decimalsOf(s / unit);
      return values.map(function (v) { return minus((v / unit).toFixed(d)).replace(/^−(0(\.0+)?)$/, "$1"); });
    };
    const most = function (labels) { return Math.max(0, ...labels.map(digits)); };
    let labels = labelled(at, 1);
    if (most(labels) <= MOST_DIGITS) return { at: at, labels: labels, note: "" };
    const largest = Math.max(Math.abs(low), Math.abs(high));
    const exponent = 3 * Math.floor(Math.log10(largest) / 3);
    labels = labelled(at, Math.pow(10, exponent));
    if (most(labels) <= MOST_DIGITS) return { at: at, labels: labels, note: exponent ? " · 10" + superscript(exponent) : "" };
    const base = at[0], from = at.map(function (v) { return v - base; });
    const e = 3 * Math.floor(Math.log10(span) / 3), unit = e < 0 || e > 3 ? Math.pow(10, e) : 1;
    return {
      at: at, labels: labelled(from, unit),
      note: " − " + minus(base.toFixed(decimalsOf(s))) + (unit === 1 ? "" : ", · 10" + superscript(e)),
    };
  }

  /* Ticks of a logarithmic axis, in data units: powers of ten, with 2 and 5 where there are few. */
  function logTicks(low, high) {
    const at = [], labels = [];
    const decades = Math.log10(high / low), every = Math.max(1, Math.ceil(decades / 6));
    for (let e = Math.floor(Math.log10(low)); e <= Math.ceil(Math.log10(high)); e++) {
      (decades < 2 ? [1, 2, 5] : e % every ? [] : [1]).forEach(function (m) {
        const v = m * Math.pow(10, e);
        if (v < low * (1 - 1e-9) || v > high * (1 + 1e-9)) return;
        at.push(v);
        labels.push(e >= -3 && e <= 3 ? String(parseFloat(v.toPrecision(3))) : (m === 1 ? "" : m + " · ") + "10" + superscript(e));
      });
    }
    return { at: at, labels: labels, note: "" };
  }

  const DAY = 864e5;
  function dateTicks(low, high, count) {
    const steps = [6e4, 3e5, 9e5, 36e5, 108e5, 432e5, DAY, 2 * DAY, 7 * DAY, 14 * DAY, 30 * DAY, 91 * DAY, 182 * DAY, 365 * DAY];
    const s = steps.find(function (x) { return (high - low) / x <= count; }) || 3650 * DAY;
    const at = [], labels = [];
    for (let t = Math.ceil(low / s) * s; t <= high; t += s) {
      const iso = new Date(t).toISOString();
      at.push(t);
      labels.push(s < DAY ? iso.slice(11, 16) : s >= 365 * DAY ? iso.slice(0, 4) : iso.slice(5, 10));
    }
    return { at: at, labels: labels, note: "" };
  }

  function significant(x, n) {
    if (x === null || x === undefined || !isFinite(x)) return "–";
    if (x === 0) return "0";
    const e = Math.floor(Math.log10(Math.abs(x)));
    return e < -4 || e >= 6 ? x.toExponential(n - 1) : String(parseFloat(x.toPrecision(n)));
  }

  /* A number by the few formats that our figures use: .3f, .4g, .4~g. */
  function format(value, spec) {
    if (typeof value !== "number") return value === null || value === undefined ? "–" : String(value);
    const found = /^\.(\d+)~?([fg])$/.exec(spec || "");
    if (!found) return minus(String(parseFloat(value.toPrecision(7))));
    return minus(found[2] === "f" ? value.toFixed(+found[1]) : significant(value, +found[1]));
  }

  /* A hover text: %{x:.3f}, %{customdata[1]}, %{marker.color:.4~g}; lines at <br>. */
  function fill(template, point) {
    return template.replace(/<extra>.*?<\/extra>/g, "").replace(/%\{([a-z.]+)(?:\[(\d+)\])?(?::([^}]*))?\}/gi, function (_, name, k, spec) {
      const v = point[name];
      return format(k === undefined || !v ? v : v[+k], spec);
    }).replace(/<br>/g, "\n");
  }

  function rgb(colour) {
    if (colour[0] === "#") {
      const h = colour.length === 4 ? colour.replace(/[0-9a-f]/gi, "$&$&") : colour;
      return [1, 3, 5].map(function (k) { return parseInt(h.slice(k, k + 2), 16); });
    }
    return (colour.match(/[\d.]+/g) || [0, 0, 0]).slice(0, 3).map(Number);
  }

  function css(c) { return "rgb(" + c.map(function (x) { return Math.round(x); }).join(",") + ")"; }

  /* The colour of a value between 0 and 1 in a scale of [place, colour] pairs. */
  function onScale(scale, s) {
    const at = Math.min(1, Math.max(0, s));
    let k = scale.findIndex(function (p) { return p[0] >= at; });
    k = k < 1 ? 1 : k;
    const a = scale[k - 1], b = scale[k], w = (at - a[0]) / (b[0] - a[0] || 1);
    const x = rgb(a[1]), y = rgb(b[1]);
    return css(x.map(function (c, i) { return c + w * (y[i] - c); }));
  }

  const DEFAULT_SCALE = [[0, "#0b2d57"], [0.35, "#2f77a8"], [0.65, "#8fbf9f"], [1, "#f2d16b"]];

  function isDark() {
    return window.matchMedia && window.matchMedia("(prefers-color-scheme: dark)").matches && !window.matchMedia("print").matches;
  }

  /* An ink as it is on the page's ground: dark inks are made lighter on a dark one. */
  function ink(colour) {
    if (!isDark() || typeof colour !== "string" || !/^(#|rgb\()/.test(colour)) return colour;
    const c = rgb(colour), light = (0.3 * c[0] + 0.59 * c[1] + 0.11 * c[2]) / 255;
    return light > 0.55 ? colour : css(c.map(function (x) { return x + (235 - x) * (0.62 - light); }));
  }

  function extent(values) {
    let low = Infinity, high = -Infinity;
    values.forEach(function (v) { if (v !== null && isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); } });
    return [low, high];
  }

  return { ticks: ticks, logTicks: logTicks, dateTicks: dateTicks, significant: significant, fill: fill, onScale: onScale,
    DEFAULT_SCALE: DEFAULT_SCALE, ink: ink, isDark: isDark, extent: extent };
})();
