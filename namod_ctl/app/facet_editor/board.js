// The two canvases: the picture below, outlines and marks above it, and the way from the screen to the picture.

import { anchor } from "./model.js";

const DAY = { line: "#ffb000", picked: "#ffffff", bad: "#ff4fd8", mark: "#00e5ff", ghost: "#7dff7d", text: "#ffffff" };
const NIGHT = { line: "#ff6a5c", picked: "#ffd0ca", bad: "#ffb3aa", mark: "#ffb3aa", ghost: "#ff8a7d", text: "#ffb3aa" };

export class Board {
  constructor(frame, picture, board) {
    Object.assign(this, { frame, picture, board, image: null, scale: 1, left: 0, top: 0, cursor: null, isWhole: true });
  }

  show(image) {
    this.image = image;
    this.cursor = [image.width / 2, image.height / 2];
    this.whole();
  }

  whole() {
    const { clientWidth: w, clientHeight: h } = this.frame;
    this.scale = Math.min(w / this.image.width, h / this.image.height);
    this.left = (w - this.scale * this.image.width) / 2;
    this.top = (h - this.scale * this.image.height) / 2;
    this.isWhole = true;
  }

  // The centre of the picture's first pixel is at (0, 0).
  toPicture(x, y) {
    return [(x - this.left) / this.scale - 0.5, (y - this.top) / this.scale - 0.5];
  }

  toScreen([x, y]) {
    return [(x + 0.5) * this.scale + this.left, (y + 0.5) * this.scale + this.top];
  }

  zoom(factor, x, y) {
    const kept = Math.min(Math.max(this.scale * factor, 0.05), 60) / this.scale;
    this.left = x - kept * (x - this.left);
    this.top = y - kept * (y - this.top);
    this.scale *= kept;
    this.isWhole = false;
  }

  pan(dx, dy) {
    this.left += dx;
    this.top += dy;
    this.isWhole = false;
  }

  draw(state, look) {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: w, clientHeight: h } = this.frame;
    for (const canvas of [this.picture, this.board]) {
      const size = [Math.round(w * ratio), Math.round(h * ratio)];
      if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    }
    const below = this.picture.getContext("2d");
    below.setTransform(ratio, 0, 0, ratio, 0, 0);
    below.clearRect(0, 0, w, h);
    below.imageSmoothingEnabled = this.scale < 3;
    if (this.image) below.drawImage(this.image, this.left, this.top, this.image.width * this.scale, this.image.height * this.scale);
    const pen = this.board.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, w, h);
    this.pen = pen;
    this.colour = look.isNight ? NIGHT : DAY;
    const marked = new Set(state.marks.map((m) => m.id)); // their numbers stand at the marks
    state.facets.forEach((facet, index) => this._outline(facet, index === look.picked, look.bad.has(facet.id), !marked.has(facet.id)));
    for (const facet of look.ghosts) this._path(facet.points, this.colour.ghost, 2, [6, 5], true);
    for (const mark of state.marks) this._mark(mark, look.suspects.has(mark.id));
    if (look.drawing.length) this._path(look.drawing, this.colour.mark, 2, [], false);
    if (look.hasCross) this._cross();
  }

  _path(points, colour, width, dash, isClosed) {
    const pen = this.pen;
    pen.beginPath();
    points.forEach((p, k) => pen[k ? "lineTo" : "moveTo"](...this.toScreen(p)));
    if (isClosed) pen.closePath();
    pen.setLineDash(dash);
    pen.strokeStyle = "rgba(0, 0, 0, 0.7)";
    pen.lineWidth = width + 2;
    pen.stroke();
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.stroke();
    pen.setLineDash([]);
  }

  _outline(facet, isPicked, isBad, isNamed) {
    const { line, picked, bad } = this.colour;
    const screen = facet.points.map((p) => this.toScreen(p));
    const xs = screen.map((p) => p[0]), ys = screen.map((p) => p[1]);
    const { clientWidth: w, clientHeight: h } = this.frame;
    if (Math.max(...xs) < 0 || Math.min(...xs) > w || Math.max(...ys) < 0 || Math.min(...ys) > h) return;
    const width = Math.max(...xs) - Math.min(...xs);
    this._path(facet.points, isPicked ? picked : isBad ? bad : line, isPicked || isBad ? 3 : width < 30 ? 1 : 1.6, isBad ? [9, 4] : [], true);
    if (isPicked || width > 120) {
      this.pen.fillStyle = isPicked ? picked : line;
      for (const [x, y] of screen) this.pen.fillRect(x - 3, y - 3, 6, 6);
    }
    if (isNamed && (width > 24 || isPicked)) {
      const x = xs.reduce((a, b) => a + b) / xs.length, y = ys.reduce((a, b) => a + b) / ys.length;
      this._text(String(facet.id), x, y, Math.min(20, Math.max(10, width / 5)), this.colour.text);
    }
  }

  _text(text, x, y, size, colour) {
    const pen = this.pen;
    pen.font = `600 ${size}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.lineWidth = 3;
    pen.strokeStyle = "#000";
    pen.strokeText(text, x, y);
    pen.fillStyle = colour;
    pen.fillText(text, x, y);
  }

  _mark(mark, isSuspect) {
    const [x, y] = this.toScreen(anchor(mark));
    const pen = this.pen, arm = isSuspect ? 16 : 11;
    for (const [colour, width] of [["#000", 5], [this.colour.mark, 2.2]]) {
      pen.beginPath();
      pen.moveTo(x - arm, y); pen.lineTo(x - 3, y); pen.moveTo(x + 3, y); pen.lineTo(x + arm, y);
      pen.moveTo(x, y - arm); pen.lineTo(x, y - 3); pen.moveTo(x, y + 3); pen.lineTo(x, y + arm);
      if (isSuspect) pen.rect(x - arm, y - arm, 2 * arm, 2 * arm);
      pen.strokeStyle = colour;
      pen.lineWidth = width;
      pen.stroke();
    }
    this._text(isSuspect ? `${mark.id} ?` : String(mark.id), x + arm + 8, y - arm, 14, this.colour.mark);
  }

  _cross() {
    const [x, y] = this.toScreen(this.cursor);
    const pen = this.pen;
    pen.beginPath();
    pen.moveTo(x - 30, y); pen.lineTo(x + 30, y); pen.moveTo(x, y - 30); pen.lineTo(x, y + 30);
    pen.strokeStyle = this.colour.text;
    pen.lineWidth = 1;
    pen.stroke();
  }
}
