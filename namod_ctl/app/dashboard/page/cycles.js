// A_sigma from cycle to cycle, as a chart and as a table.

import { byId, drawn, element, number, setText } from "./dom.js";

const [WIDTH, HEIGHT, LEFT, BOTTOM, TOP] = [400, 200, 44, 26, 12];

export function showCycles(cycles) {
  byId("cycles-section").hidden = cycles.length === 0;
  byId("cycles-table").replaceChildren(...cycles.map(row));
  setText(byId("decision"), cycles.findLast((cycle) => cycle.decision)?.decision ?? "");
  drawChart(cycles);
}

function row(cycle) {
  const measured = cycle.now === null ? "–" : `${number(cycle.now)} ± ${number(cycle.uncertainty)}`;
  const cells = [cycle.n_records, measured, area(cycle.predicted), area(cycle.limit)];
  return element("tr", {}, element("th", { scope: "row" }, String(cycle.cycle)), ...cells.map((text) => element("td", {}, String(text))));
}

const area = (value) => (value === null ? "–" : number(value));

function drawChart(cycles) {
  const chart = byId("cycles-chart");
  chart.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  const measured = cycles.filter((cycle) => cycle.now !== null);
  chart.toggleAttribute("hidden", measured.length === 0);
  if (!measured.length) return;
  const most = 1.12 * Math.max(...measured.map((cycle) => cycle.now), ...measured.map((cycle) => cycle.limit ?? 0));
  const last = Math.max(...cycles.map((cycle) => cycle.cycle)) + 1;
  const x = (cycle) => LEFT + ((cycle - 0.5) / last) * (WIDTH - LEFT);
  const y = (value) => HEIGHT - BOTTOM - (Math.min(Math.max(value, 0), 1.03 * most) / most) * (HEIGHT - BOTTOM - TOP);
  const parts = ticks(most).flatMap((value) => [
    drawn("line", { x1: LEFT, x2: WIDTH, y1: y(value), y2: y(value), class: "grid" }),
    drawn("text", { x: LEFT - 6, y: y(value) + 4, "text-anchor": "end", "font-size": 12, class: "axis-text" }, String(value)),
  ]);
  const limit = measured.at(-1).limit;
  if (limit !== null) parts.push(drawn("line", { x1: LEFT, x2: WIDTH, y1: y(limit), y2: y(limit), class: "limit-line" }));
  parts.push(drawn("polyline", { points: measured.map((cycle) => `${x(cycle.cycle)},${y(cycle.now)}`).join(" "), class: "curve" }));
  for (const cycle of measured) {
    const [px, py] = [x(cycle.cycle), y(cycle.now)];
    if (cycle.uncertainty !== null) parts.push(drawn("line", { x1: px, x2: px, y1: y(cycle.now - cycle.uncertainty), y2: y(cycle.now + cycle.uncertainty), class: "bar" }));
    parts.push(drawn("circle", { cx: px, cy: py, r: 5, class: "dot" }));
    if (cycle.predicted !== null && cycle.predicted < most) {
      const [qx, qy] = [x(cycle.cycle + 1), y(cycle.predicted)];
      parts.push(drawn("path", { d: `M${qx - 6} ${qy}l6-6 6 6-6 6z`, class: "diamond" }));
    }
  }
  for (const cycle of cycles) parts.push(drawn("text", { x: x(cycle.cycle), y: HEIGHT - 8, "text-anchor": "middle", "font-size": 12, class: "axis-text" }, String(cycle.cycle)));
  parts.push(drawn("text", { x: WIDTH, y: HEIGHT - 8, "text-anchor": "end", "font-size": 12, class: "axis-text" }, "cycle; arcmin²"));
  chart.replaceChildren(...parts);
  chart.setAttribute("aria-label", measured.map((cycle) => `cycle ${cycle.cycle}: ${number(cycle.now)} square arcmin`).join(", "));
}

function ticks(most) {
  const decade = 10 ** Math.floor(Math.log10(most));
  const step = [0.2, 0.5, 1].map((share) => share * decade).find((each) => most / each <= 6) ?? 2 * decade;
  return Array.from({ length: Math.floor(most / step) + 1 }, (_, i) => Number((i * step).toPrecision(3)));
}
