// What is drawn and marked, with undo. A facet is {id, points: [[x, y], ...]}, in pixels of the picture.

const MAX_STEPS = 200;

export class Model {
  constructor(facets) {
    this.state = { facets, marks: [], basis: "hand" };
    this.past = [];
    this.future = [];
  }

  // Every change goes through here: `make` gets a copy and changes it.
  change(make) {
    const next = structuredClone(this.state);
    make(next);
    this.past.push(this.state);
    if (this.past.length > MAX_STEPS) this.past.shift();
    this.future = [];
    this.state = next;
  }

  // What follows from the last change by itself, so that one undo takes both back.
  amend(make) {
    const next = structuredClone(this.state);
    make(next);
    this.state = next;
  }

  undo() {
    if (!this.past.length) return false;
    this.future.push(this.state);
    this.state = this.past.pop();
    return true;
  }

  redo() {
    if (!this.future.length) return false;
    this.past.push(this.state);
    this.state = this.future.pop();
    return true;
  }

  mark(id, points) {
    this.change((s) => {
      s.marks = s.marks.filter((m) => m.id !== id);
      s.marks.push({ id, points });
    });
  }
}

// Where a mark stands: its one point, or the middle of the outline it was made of.
export function anchor(mark) {
  const sum = mark.points.reduce((a, p) => [a[0] + p[0], a[1] + p[1]], [0, 0]);
  return [sum[0] / mark.points.length, sum[1] / mark.points.length];
}

export function isInside(points, [x, y]) {
  let inside = false;
  for (let i = 0, j = points.length - 1; i < points.length; j = i++) {
    const [xi, yi] = points[i], [xj, yj] = points[j];
    if ((yi > y) !== (yj > y) && x < ((xj - xi) * (y - yi)) / (yj - yi) + xi) inside = !inside;
  }
  return inside;
}

// What lies at a place: a mark, a corner of an outline, an outline, or null. `reach` is in pixels of the picture.
export function hit(state, place, reach) {
  let best = null, distance = reach;
  const consider = (point, what) => {
    const d = Math.hypot(point[0] - place[0], point[1] - place[1]);
    if (d < distance) [distance, best] = [d, what];
  };
  state.marks.forEach((m, index) => consider(anchor(m), { kind: "mark", index }));
  if (best) return best;
  state.facets.forEach((f, index) => f.points.forEach((p, corner) => consider(p, { kind: "corner", index, corner })));
  if (best) return best;
  const index = state.facets.findIndex((f) => isInside(f.points, place));
  return index < 0 ? null : { kind: "facet", index };
}

// The change that puts what was hit `by` (dx, dy) away from where it was.
export function moved(state, what, by) {
  const shift = (p) => [p[0] + by[0], p[1] + by[1]];
  if (what.kind === "mark") state.marks[what.index].points = state.marks[what.index].points.map(shift);
  else if (what.kind === "facet") state.facets[what.index].points = state.facets[what.index].points.map(shift);
  else {
    const points = state.facets[what.index].points;
    points[what.corner] = shift(points[what.corner]);
  }
}
