// The star's size over the last minutes, with the best so far as a line.

import { byId, drawn } from "./dom.js";

const [WIDTH, HEIGHT, LEFT, BOTTOM, TOP] = [400, 220, 44, 26, 22];
const GAP_S = 8; // the line is broken where no star was measured for so long, as nobody knows what was between
const [LEAST_SPAN, LARGEST_SPAN] = [1.25, 5]; // the figure reaches up to so many times the best size,
const RECENT_S = 30; // as sizes of the last seconds need: what was higher leaves it, so that the end is told finely

export function drawCurve(course, bestPx, perPx, unit, shownS) {
  const chart = byId("curve");
  chart.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  const seen = course.filter(([, size]) => size !== null);
  if (!seen.length || bestPx === null) {
    chart.replaceChildren();
    return;
  }
  const now = course.at(-1)[0];
  const best = bestPx * perPx;
  const recent = seen.filter(([time]) => time >= now - RECENT_S);
  const largest = Math.max(0, ...recent.map(([, size]) => size * perPx));
  const high = Math.min(Math.max(1.08 * largest, LEAST_SPAN * best), LARGEST_SPAN * best);
  const low = Math.max(0, best - 0.15 * (high - best));
  const x = (time) => WIDTH - 8 - ((now - time) / shownS) * (WIDTH - 8 - LEFT);
  const y = (size) => HEIGHT - BOTTOM - ((size - low) / (high - low)) * (HEIGHT - BOTTOM - TOP);
  const parts = ticks(low, high).flatMap((value) => [
    drawn("line", { x1: LEFT, x2: WIDTH, y1: y(Number(value)), y2: y(Number(value)), class: "grid" }),
    drawn("text", { x: LEFT - 6, y: y(Number(value)) + 5, "text-anchor": "end", "font-size": 14, class: "axis-text" }, value),
  ]);
  for (const ago of [0, 30, 60, 90, 120].filter((each) => each <= shownS)) {
    const anchor = ago === 0 ? "end" : "middle";
    parts.push(drawn("text", { x: ago === 0 ? WIDTH : x(now - ago), y: HEIGHT - 6, "text-anchor": anchor, "font-size": 14, class: "axis-text" }, ago === 0 ? "now" : `−${ago} s`));
  }
  parts.push(drawn("text", { x: LEFT + 6, y: TOP - 8, "font-size": 14, class: "axis-text" }, unit));
  parts.push(drawn("line", { x1: LEFT, x2: WIDTH, y1: y(best), y2: y(best), class: "best-line" }));
  const lines = stretches(seen).map((stretch) => drawn("polyline", { points: stretch.map(([time, size]) => `${x(time).toFixed(1)},${y(size * perPx).toFixed(1)}`).join(" "), class: "curve" }));
  const window = { x: 0, y: TOP, width: WIDTH, height: HEIGHT - TOP - BOTTOM, viewBox: `0 ${TOP} ${WIDTH} ${HEIGHT - TOP - BOTTOM}` };
  parts.push(drawn("svg", window, ...lines)); // what is outside of it is not seen
  const [time, size] = seen.at(-1);
  parts.push(drawn("circle", { cx: x(time), cy: y(Math.min(size * perPx, high)), r: 6, class: "now-dot" }));
  chart.replaceChildren(...parts);
  chart.setAttribute("aria-label", `Star size: ${(size * perPx).toFixed(2)} ${unit}, best ${best.toFixed(2)} ${unit}`);
}

function stretches(seen) {
  const found = [[seen[0]]];
  for (const [i, each] of seen.entries()) {
    if (i === 0) continue;
    if (each[0] - seen[i - 1][0] > GAP_S) found.push([]);
    found.at(-1).push(each);
  }
  return found;
}

function ticks(low, high) {
  const decade = 10 ** Math.floor(Math.log10(high - low));
  const step = [0.1, 0.2, 0.5, 1].map((share) => share * decade).find((each) => (high - low) / each <= 6) ?? 2 * decade;
  const first = Math.ceil(low / step);
  const figures = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return Array.from({ length: Math.floor(high / step) - first + 1 }, (_, i) => ((first + i) * step).toFixed(figures));
}
