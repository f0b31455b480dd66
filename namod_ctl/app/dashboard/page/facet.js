// One facet: its light over star directions, its history, its legs, and what stands against it.

import { legState, planInWords } from "./campaign.js";
import { colour } from "./colours.js";
import { byId, drawn, element, ellipseMark, number, setNumbers, setText } from "./dom.js";
import { markChosen, whenChosen } from "./mirror.js";

const EVERY_MS = 2000;
const REST_MS = 120; // a pointer on its way across the mirror asks for nothing

let chosen = null;
let light = null; // of the facet that is chosen: {id, run, samples}
let begun = -Infinity;
let timer = 0;
let latest = {};

export function setUpFacet(about) {
  const ids = about.facets.map((facet) => facet.id);
  const choice = byId("facet-choice");
  choice.replaceChildren(...ids.map((id) => element("option", { value: id }, String(id))));
  choice.onchange = () => choose(Number(choice.value));
  whenChosen(choose);
  if (!ids.includes(chosen)) {
    if (ids.length) choose(ids[0]);
    return;
  }
  choice.value = String(chosen); // the mirror is drawn anew after every loss of the connection
  markChosen(chosen);
}

function choose(id) {
  if (id === chosen) return;
  chosen = id;
  light = null;
  byId("facet-choice").value = String(id);
  markChosen(id);
  showFacetDetails(latest);
  clearTimeout(timer);
  timer = setTimeout(ask, REST_MS);
}

export function refreshFacet(known) {
  latest = known;
  if (timer || chosen === null) return;
  timer = setTimeout(ask, Math.max(0, begun + EVERY_MS - performance.now()));
}

async function ask() {
  timer = 0;
  begun = performance.now();
  const id = chosen;
  try {
    const answer = await fetch(`/facet/${id}`);
    if (answer.ok && id === chosen) {
      light = await answer.json();
      showFacetDetails(latest);
    }
  } catch {
    // the banner tells that there is no connection
  }
}

export function showFacetDetails(known) {
  latest = known;
  if (chosen === null) return;
  const facet = known.facets?.table.find((each) => each.id === chosen);
  const refused = known.standing?.refused.find((each) => each.id === chosen);
  const legs = known.actuators?.legs.filter((leg) => leg.facet === chosen) ?? [];
  const pairs = [];
  if (facet) {
    const isKnown = facet.off_arcmin !== null;
    pairs.push(["its normal is off by", isKnown ? size(facet) : "not known"]);
    if (facet.width_arcmin[0] !== null) pairs.push(["image", `${number(facet.width_arcmin[0])} × ${number(facet.width_arcmin[1])} arcmin`]);
    if (facet.n_records !== null) pairs.push(["records in it", String(facet.n_records)]);
    if (facet.history.length > 1) pairs.push(["by cycle", facet.history.map(([cycle, off]) => `${cycle}: ${number(off)}`).join(", ")]);
  }
  for (const leg of legs) pairs.push([`leg ${leg.leg}`, `${leg.position_mm === null ? "where is not known" : `${number(leg.position_mm, 3)} mm`}; ${[planInWords(leg), legState(leg)].filter((text) => text).join("; ")}`]);
  setNumbers(byId("facet-numbers"), pairs);
  const remarks = [...(facet?.flags.map((flag) => flag.meaning) ?? []), ...(facet?.remarks ?? [])];
  if (refused) remarks.push(`stays as it is: ${refused.why}`);
  byId("facet-remarks").replaceChildren(...remarks.map((text) => element("li", {}, text)));
  paintLight(facet, known.psf);
}

function size(facet) {
  if (facet.off_uncertainty_arcmin === null) return `about ${number(facet.off_arcmin, 1)} arcmin`;
  return `${number(facet.off_arcmin)} ± ${number(facet.off_uncertainty_arcmin)} arcmin`;
}

function paintLight(facet, psf) {
  const canvas = byId("facet-map");
  const context = canvas.getContext("2d");
  const size = canvas.width;
  context.clearRect(0, 0, size, size);
  const samples = light?.id === chosen ? light.samples : [];
  const reach = Math.max(...samples.map(([x, y]) => Math.max(Math.abs(x), Math.abs(y))), 1) * 1.05;
  const values = samples.map((sample) => sample[2]);
  const [least, most] = [Math.min(...values), Math.max(...values)];
  const radius = Math.max(2.5, Math.min(8, (0.45 * size) / Math.sqrt(samples.length + 1)));
  const place = (x, y) => [((x / reach + 1) / 2) * size, ((1 - y / reach) / 2) * size];
  for (const [x, y, value] of [...samples].sort((one, other) => one[2] - other[2])) {
    context.fillStyle = colour(0.25 + 0.75 * ((value - least) / (most - least || 1)));
    context.beginPath();
    context.arc(...place(x, y), radius, 0, 7);
    context.fill();
  }
  const marks = byId("facet-marks");
  marks.setAttribute("viewBox", `${-reach} ${-reach} ${2 * reach} ${2 * reach}`);
  const parts = [];
  if (psf) parts.push(cross(psf.axis_arcmin, 0.06 * reach, "cross"));
  if (facet?.ellipse_arcmin) {
    const [major, minor, angle] = facet.ellipse_arcmin;
    parts.push(ellipseMark([Math.max(3 * major, 0.05 * reach), Math.max(3 * minor, 0.05 * reach), angle], facet.theta_arcmin, "ellipse"));
  }
  marks.replaceChildren(...parts);
  const text = samples.length ? `${samples.length} records over ±${number(reach, 0)} arcmin; bright: the facet shines.` : "No records yet.";
  setText(byId("facet-caption"), facet?.ellipse_arcmin ? `${text} Ring: its centre. Cross: where it should be.` : text);
  canvas.setAttribute("aria-label", `Light of facet ${chosen} over star directions. ${text}`);
}

const cross = ([x, y], arm, name) => drawn("path", { d: `M${x - arm} ${-y}h${2 * arm}M${x} ${-y - arm}v${2 * arm}`, class: name });
