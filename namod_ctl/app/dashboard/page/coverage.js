// Where the star has stood, cell by cell, where it stands now and where to bring it. +x right, +y up.

import { colour } from "./colours.js";
import { byId, drawn, setText } from "./dom.js";

const STAR = "M0-.5.12-.15.48-.15.2.07.3.42 0 .21-.3.42-.2.07-.48-.15-.12-.15z";

export function showCoverage(now, standing) {
  const { counts, inside, most, radius_deg: radius, share } = now.coverage;
  const n = counts.length;
  const chart = byId("coverage");
  chart.setAttribute("viewBox", `0 0 ${n} ${n + 0.9}`);
  // nobody is told to steer for a recording that has ended, or whose program is gone
  const isSteered = standing?.is_running && ["recording", "paused"].includes(standing.state) && !now.live?.ended;
  const steering = isSteered ? now.steering : "nothing is recorded at the moment";
  setText(byId("steering"), steering[0].toUpperCase() + steering.slice(1));
  const place = ([x, y]) => [((x / radius + 1) / 2) * n, ((1 - y / radius) / 2) * n];
  const parts = [];
  counts.forEach((row, r) => row.forEach((count, c) => {
    if (!inside[r][c] && !count) return;
    const cell = drawn("rect", { x: c, y: n - 1 - r, width: 1, height: 1, class: "cell" });
    cell.style.fill = count ? colour(0.25 + 0.75 * (count / most)) : "var(--dark-picture)";
    parts.push(cell);
  }));
  const goal = place(now.next_deg);
  if (now.theta_deg.every((value) => value !== null)) {
    const star = place(now.theta_deg);
    if (isSteered) parts.push(drawn("line", { x1: star[0], y1: star[1], x2: goal[0], y2: goal[1], class: "way" }));
    parts.push(drawn("path", { d: STAR, transform: `translate(${star[0]} ${star[1]}) scale(1.5)`, class: "star-mark" }));
  }
  if (isSteered) parts.push(drawn("path", { d: `M${goal[0] - 0.45} ${goal[1]}h.9M${goal[0]} ${goal[1] - 0.45}v.9`, class: "goal-mark" }));
  const text = { y: n + 0.65, "font-size": 0.5, class: "axis-text" };
  parts.push(drawn("text", { ...text, x: 0 }, `${(-radius).toFixed(2)}°`));
  parts.push(drawn("text", { ...text, x: n, "text-anchor": "end" }, `+${radius.toFixed(2)}°`));
  chart.replaceChildren(...parts);
  chart.setAttribute("aria-label", `${Math.round(100 * (share ?? 0))} per cent of the region have a record. ${steering}.`);
}
