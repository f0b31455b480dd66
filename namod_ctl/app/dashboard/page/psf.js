// The light of all facets together: now, and as it should be after the correction, with the areas.

import { paintCells } from "./colours.js";
import { byId, ellipseMark, number, setText } from "./dom.js";

export function showPsf(psf) {
  for (const id of ["psf", "psf-key"]) byId(id).hidden = psf === null;
  byId("psf-missing").hidden = psf !== null;
  if (psf === null) return;
  const reach = psf.reach_arcmin;
  const limit = psf.area_limit === null ? [] : [circle(psf.area_limit, "ellipse limit")];
  const now = psf.ellipse_arcmin ? [ellipseMark(psf.ellipse_arcmin, psf.centre_arcmin, "ellipse")] : [];
  const predicted = psf.area_predicted === null ? [] : [circle(psf.area_predicted, "ellipse")];
  show("psf-now", psf.now, [...now, ...limit], reach);
  show("psf-predicted", psf.predicted, [...predicted, ...limit.map((mark) => mark.cloneNode())], reach);
  const doubt = psf.area_now_uncertainty === null ? "" : ` ± ${number(psf.area_now_uncertainty)}`;
  setText(byId("psf-now-text"), `Now: ${number(psf.area_now)}${doubt} arcmin²`);
  const best = psf.area_limit === null ? "" : `; limit ${number(psf.area_limit)}`;
  setText(byId("psf-predicted-text"), `Predicted: ${number(psf.area_predicted)} arcmin²${best}`);
}

// an area of one sigma: pi r^2
const circle = (area, name) => { const r = Math.sqrt(area / Math.PI); return ellipseMark([r, r, 0], [0, 0], name); };

function show(id, cells, marks, reach) {
  paintCells(byId(id), cells);
  const overlay = byId(`${id}-marks`);
  overlay.setAttribute("viewBox", `${-reach} ${-reach} ${2 * reach} ${2 * reach}`);
  overlay.replaceChildren(...marks);
}
