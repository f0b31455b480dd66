// Bolts and the way each is turned, drawn as the person who turns them sees it. Units of the sheet: m, y up.

import { drawn, element } from "./dom.js";

const [FROM, TO] = [Math.PI / 4, (300 / 180) * Math.PI]; // of the arrow, from the top: the gap is at the top
const MAP_LEGIBLE = 120; // facets: arrows of more are too small to be told apart

function roundArrow([x, y], radius, isClockwise) {
  const side = isClockwise ? 1 : -1;
  const at = (angle, r) => [x + side * r * Math.sin(angle), y - r * Math.cos(angle)];
  const [begin, end] = [at(FROM, radius), at(TO, radius)];
  const [inner, outer] = [at(TO, 0.62 * radius), at(TO, 1.38 * radius)];
  const tip = [end[0] + side * 0.66 * radius * Math.cos(TO), end[1] + 0.66 * radius * Math.sin(TO)];
  return [
    drawn("path", { d: `M${begin}A${radius} ${radius} 0 1 ${isClockwise ? 1 : 0} ${end}`, class: "turn", "stroke-width": 0.24 * radius }),
    drawn("path", { d: `M${inner}L${outer}L${tip}Z`, class: "turn-head" }),
  ];
}

function bolt(place, radius, number, { sense }) {
  const parts = sense
    ? roundArrow(place, radius, sense === "clockwise")
    : [drawn("circle", { cx: place[0], cy: place[1], r: 0.8 * radius, class: "leave", "stroke-width": 0.1 * radius })];
  if (number) parts.push(drawn("text", { x: place[0], y: place[1], "font-size": 1.05 * radius, class: "bolt-number" }, number));
  return parts;
}

function frame(outlines, margin) {
  const corners = outlines.flat();
  const [xs, ys] = [corners.map(([x]) => x), corners.map(([, y]) => -y)];
  const [left, top] = [Math.min(...xs), Math.min(...ys)];
  const [width, height] = [Math.max(...xs) - left, Math.max(...ys) - top];
  const edge = margin * Math.max(width, height);
  return { box: `${left - edge} ${top - edge} ${width + 2 * edge} ${height + 2 * edge}`, centre: [left + width / 2, top + height / 2], width };
}

const points = (outline) => outline.map(([x, y]) => `${x},${-y}`).join(" ");
const inward = ([cx, cy], [x, y], share) => [cx + share * (x - cx), cy + share * (-y - cy)];

export function drawFacet(svg, facet) {
  const { box, centre, width } = frame([facet.outline], 0.04);
  svg.setAttribute("viewBox", box);
  const parts = [];
  const ends = facet.legs.map((leg) => inward(centre, leg, 0.66));
  for (const [x, y] of ends) parts.push(drawn("path", { d: `M${centre}L${x} ${y}`, class: "arm", "stroke-width": 0.008 * width }));
  for (const [cx, cy] of ends) parts.push(drawn("circle", { cx, cy, r: 0.19 * width, class: "ground" }));
  parts.push(drawn("polygon", { points: points(facet.outline), class: facet.verdict === "do not turn" ? "mirror-edge forbidden" : "mirror-edge", "stroke-width": 0.012 * width }));
  ends.forEach((end, i) => {
    parts.push(...(facet.bolts.length ? bolt(end, 0.125 * width, String(i + 1), facet.bolts[i]) : bolt(end, 0.08 * width, String(i + 1), { sense: "" })));
  });
  svg.replaceChildren(...parts);
  svg.setAttribute("aria-label", `Facet ${facet.id} as you see it: ${inWords(facet)}`);
}

export const inWords = (facet) => (facet.bolts.length
  ? facet.bolts.map(({ turn, sense }, i) => `bolt ${i + 1}: ${turn}${sense ? ` ${sense}` : ""}`).join(", ")
  : facet.verdict);

// the mirror with all bolts; the nodes of each facet by its id, and what marks the one that is chosen
export function drawMirror(svg, facets, others, onChoice) {
  const all = [...facets, ...others].map(({ outline }) => outline);
  svg.setAttribute("viewBox", frame(all, 0.01).box);
  const nodes = new Map();
  const isLegible = all.length <= MAP_LEGIBLE;
  const parts = others.map(({ outline }) => drawn("polygon", { points: points(outline), class: "mirror-edge other" }));
  const [bolts, names] = [[], []];
  for (const facet of facets) {
    const { centre, width } = frame([facet.outline], 0);
    const node = drawn("polygon", { points: points(facet.outline) });
    const name = drawn("text", { x: centre[0], y: centre[1], "font-size": 0.24 * width, class: "mirror-name" }, String(facet.id));
    const tick = drawn("text", { x: centre[0] - 0.1 * width, y: centre[1] + 0.26 * width, "font-size": 0.24 * width, class: "mirror-name" });
    node.addEventListener("click", () => onChoice(facet.id));
    nodes.set(facet.id, { node, tick });
    parts.push(node);
    names.push(name, tick);
    if (isLegible) facet.bolts.forEach((each, i) => bolts.push(...bolt(inward(centre, facet.legs[i], 0.7), 0.085 * width, "", each)));
  }
  const ring = drawn("polygon", { points: "", class: "chosen" }); // over its neighbours' edges
  svg.replaceChildren(...parts, ring, ...bolts, ...names);
  const mark = (facet) => ring.setAttribute("points", points(facet.outline));
  return { nodes, mark };
}

export function boltLine({ turn, sense }, i) {
  const icon = drawn("svg", { viewBox: "-1.7 -1.7 3.4 3.4", class: "bolt-icon", "aria-hidden": "true" }, ...bolt([0, 0], 1.15, String(i + 1), { sense }));
  return element("li", { class: "bolt" }, icon,
    element("span", { class: "unseen" }, `bolt ${i + 1}: `),
    element("span", { class: "bolt-words" }, element("strong", {}, turn), ...(sense ? [element("span", {}, sense)] : [])));
}
