// The reflector: every facet where it is in the picture, coloured by how far its normal is off.

import { colour, paintScale } from "./colours.js";
import { byId, drawn, number, setText } from "./dom.js";
import { Picture } from "./picture.js";

const nodes = new Map(); // facet id -> polygon
let geometry = [];
let picture = null;
let known = false;
let onChoice = () => {};

export const whenChosen = (callback) => { onChoice = callback; };

export function setUpMirror(about) {
  const map = byId("mirror");
  const { columns, rows } = about.reflector_camera;
  map.setAttribute("viewBox", `0 0 ${columns} ${rows}`);
  geometry = about.facets;
  picture ??= new Picture(byId("mirror-image"), "reflector_camera");
  nodes.clear();
  const size = 0.5 * Math.sqrt((columns * rows) / Math.max(geometry.length, 1)) * 0.4;
  const parts = geometry.map((facet, i) => {
    const points = facet.corners.map((corner) => corner.join(",")).join(" ");
    const node = drawn("polygon", { points, class: "facet unknown", role: "option", "aria-selected": "false", tabindex: i ? "-1" : "0", "aria-label": `facet ${facet.id}` });
    node.addEventListener("click", () => onChoice(facet.id));
    node.addEventListener("focus", () => onChoice(facet.id));
    node.addEventListener("pointerenter", (event) => { if (event.pointerType === "mouse") onChoice(facet.id); });
    node.addEventListener("keydown", (event) => walk(event, facet));
    nodes.set(facet.id, node);
    return node;
  });
  const names = geometry.length > 300 ? [] : geometry.map((facet) =>
    drawn("text", { x: facet.centre[0], y: facet.centre[1], "font-size": Math.min(size, rows / 28), class: "facet-name", "aria-hidden": "true" }, String(facet.id)));
  map.replaceChildren(...parts, ...names);
}

export function markChosen(id) {
  for (const [each, node] of nodes) {
    node.setAttribute("aria-selected", String(each === id));
    node.setAttribute("tabindex", each === id ? "0" : "-1");
  }
}

export function showFacets({ of, table }) {
  const offs = table.flatMap((facet) => [facet.off_arcmin, ...facet.history.map(([, off]) => off)]).filter((off) => off !== null);
  const most = roundUp(Math.max(...offs, 0.1));
  setText(byId("mirror-of"), `As measured in ${of}.`);
  known = true;
  for (const facet of table) {
    const node = nodes.get(facet.id);
    if (!node) continue;
    const isKnown = facet.off_arcmin !== null;
    node.setAttribute("class", `facet${isKnown ? "" : " unknown"}${facet.is_refused ? " refused" : ""}`);
    node.style.fill = isKnown ? colour(facet.off_arcmin / most) : "";
    const flags = facet.flags.map((flag) => flag.meaning).join("; ");
    node.setAttribute("aria-label", `facet ${facet.id}, ${isKnown ? `its normal is off by ${number(facet.off_arcmin)} arcmin` : "not known"}${flags ? `, ${flags}` : ""}`);
  }
  paintScale(byId("mirror-scale"));
  setText(byId("mirror-key"), `normals off by 0 to ${most} arcmin; dashed: not to be moved. As the reflector camera sees it, from the front.`);
}

export function showMirrorPicture(now) {
  picture.show(now);
  for (const node of nodes.values()) node.style.fillOpacity = picture.isKept ? "0.5" : "1";
  if (!known) setText(byId("mirror-of"), "There is no estimate of the facets yet.");
}

function roundUp(value) {
  const decade = 10 ** Math.floor(Math.log10(value));
  return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].map((step) => Number((step * decade).toPrecision(2))).find((step) => step >= value);
}

function walk(event, facet) {
  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  let next = null;
  if (event.key === "Home") next = geometry[0];
  else if (event.key === "End") next = geometry.at(-1);
  else if (ways[event.key]) next = neighbour(facet, ways[event.key]);
  else if (event.key === "Enter" || event.key === " ") next = facet;
  else return;
  event.preventDefault();
  if (next) nodes.get(next.id).focus();
}

function neighbour(facet, [dx, dy]) {
  let best = null;
  let least = Infinity;
  for (const other of geometry) {
    const [x, y] = [other.centre[0] - facet.centre[0], other.centre[1] - facet.centre[1]];
    const along = x * dx + y * dy;
    const across = Math.abs(x * dy - y * dx);
    if (along <= 1e-6 || across > 2 * along) continue;
    if (along + 2 * across < least) [best, least] = [other, along + 2 * across];
  }
  return best;
}
