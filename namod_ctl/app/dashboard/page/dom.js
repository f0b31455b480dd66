// Making and filling elements. Text goes in as text only: what a config calls a facet or a telescope is never markup.

const SVG = "http://www.w3.org/2000/svg";

export const byId = (id) => document.getElementById(id);

export function element(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

export function drawn(tag, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

export function setNumbers(list, pairs) {
  list.replaceChildren(...pairs.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
}

export const number = (value, digits = 2) => (value === null || value === undefined ? "not known" : value.toFixed(digits));

export const isNight = () => document.documentElement.dataset.mode === "night";

export function nextMessage(node, text) {
  node.textContent = "";
  requestAnimationFrame(() => { node.textContent = text; }); // the same words again are spoken again
}

export function ellipseMark([major, minor, angle], [x, y], className) {
  // angles count from +x to +y, and y points up: down in the picture's own axes
  return drawn("ellipse", { cx: x, cy: -y, rx: major, ry: minor, transform: `rotate(${-angle} ${x} ${-y})`, class: className });
}
