/* The part of a radiograph about a ball: pixels, brightness, zoom, and what is drawn over them. */
const FOUND = "#ff9d2e", PREDICTED = "#39c0ff", START = "#ff5c8a";

export class Picture {
  constructor(canvas, load) {
    this.canvas = canvas;
    this.load = load;
    this.kept = new Map();
    this.half = null;
    this.level = 0;
    this.spread = 1;
    this.start = null;
    this.row = null;
  }

  centreOf(row) {
    const first = [row.outline && row.outline.slice(0, 2), row.x, row.predicted].find((c) => c && c[0] !== null);
    return first || [0, 0];
  }

  halfOf(row) {
    return this.half || Math.min(512, Math.round(row.outline ? row.outline[2] * 1.45 + 6 : 90));
  }

  /* The crop of a row: asked for once, kept for the last thirty. */
  crop(k, row) {
    const half = this.halfOf(row), [u, v] = this.centreOf(row), key = [k, half, Math.round(u), Math.round(v)].join();
    if (!this.kept.has(key)) {
      if (this.kept.size > 30) this.kept.delete(this.kept.keys().next().value);
      this.kept.set(key, this.load(k, u, v, half));
    }
    return this.kept.get(key);
  }

  async show(k, row) {
    this.row = row;
    const crop = await this.crop(k, row);
    if (this.row !== row) return;
    this.shown = crop;
    this.draw();
    if (crop) this.canvas.dataset.drawn = String(k);
  }

  draw() {
    const crop = this.shown, c = this.canvas.getContext("2d");
    const ratio = window.devicePixelRatio || 1, side = Math.max(200, this.canvas.parentNode.clientWidth), row = this.row;
    this.canvas.width = side * ratio;
    this.canvas.height = (crop ? Math.min(1.2, crop.height / crop.width) : 1) * side * ratio;
    c.fillStyle = "#000";
    c.fillRect(0, 0, this.canvas.width, this.canvas.height);
    if (!crop || !row) return;
    this.scale = this.canvas.width / crop.width;
    this.pixels(c, crop);
    const line = 1.6 * ratio;
    c.lineWidth = line;
    if (row.outline) this.ellipse(c, row.outline);
    if (row.x && row.x[0] !== null) this.cross(c, row.x, FOUND, 9 * ratio, false);
    if (row.predicted && row.predicted[0] !== null) this.cross(c, row.predicted, PREDICTED, 13 * ratio, true);
    if (this.start) { c.lineWidth = 2 * line; this.cross(c, this.start, START, 17 * ratio, false); }
  }

  pixels(c, crop) {
    const { width, height, low, high, data } = crop, middle = (low + high) / 2 + this.level * (high - low);
    const black = middle - this.spread * (high - low) / 2, gain = 255 / (this.spread * (high - low) || 1);
    const image = new ImageData(width, height);
    for (let v = 0; v < height; v++) {
      const from = (height - 1 - v) * width;
      for (let u = 0; u < width; u++) {
        const g = (data[from + u] - black) * gain, i = 4 * (v * width + u);
        image.data[i] = image.data[i + 1] = image.data[i + 2] = g;
        image.data[i + 3] = 255;
      }
    }
    const own = new OffscreenCanvas(width, height);
    own.getContext("2d").putImageData(image, 0, 0);
    c.imageSmoothingEnabled = false;
    c.drawImage(own, 0, 0, width * this.scale, height * this.scale);
  }

  /* Pixel (u, v) in D, v upwards, as a place on the canvas. */
  place([u, v]) {
    return [(u - this.shown.u0 + 0.5) * this.scale, (this.shown.height - 0.5 - (v - this.shown.v0)) * this.scale];
  }

  pixelAt(x, y) {
    const ratio = this.canvas.width / this.canvas.clientWidth;
    return [x * ratio / this.scale - 0.5 + this.shown.u0, this.shown.height - 0.5 - y * ratio / this.scale + this.shown.v0];
  }

  ellipse(c, [u, v, a, b, angle]) {
    const [x, y] = this.place([u, v]);
    c.strokeStyle = FOUND;
    c.beginPath();
    c.ellipse(x, y, a * this.scale, b * this.scale, -angle, 0, 2 * Math.PI);
    c.stroke();
  }

  cross(c, at, colour, arm, turned) {
    const [x, y] = this.place(at), d = turned ? arm * 0.7 : arm, e = turned ? d : 0;
    c.strokeStyle = colour;
    c.beginPath();
    c.moveTo(x - d, y - e); c.lineTo(x + d, y + e);
    c.moveTo(x - e, y + d); c.lineTo(x + e, y - d);
    c.stroke();
  }
}
