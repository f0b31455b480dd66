// The star camera's picture with the star's centroid, where frames are kept; else where the star would be in it.

import { byId, drawn, number, setText } from "./dom.js";
import { Picture } from "./picture.js";

let camera = null;
let picture = null;

export function setUpStar(about) {
  camera = about.star_camera;
  byId("star").setAttribute("viewBox", `0 0 ${camera.columns} ${camera.rows}`);
  picture ??= new Picture(byId("star-image"), "star_camera", drawRing);
}

export function showStar(now) {
  const [x, y] = now.theta_deg;
  const where = x === null ? "The star was not seen in the last record." : `The star stands at ${number(x, 3)}°, ${number(y, 3)}°; ${now.star}.`;
  setText(byId("star-text"), where);
  picture.show(now, now.frame_star_px);
  setText(byId("star-missing"), picture.isKept ? "" : "Pictures are not kept in this run; the ring shows where the star is in the camera's field.");
  if (!picture.isKept) drawRing(now.star_px);
  byId("star").setAttribute("aria-label", where);
}

function drawRing(star) {
  const marks = [];
  if (star) {
    const [cx, cy] = star;
    const radius = Math.max(1.5 * camera.star_px, camera.columns / 60);
    marks.push(drawn("circle", { cx, cy, r: radius, class: "star-ring" }));
    marks.push(drawn("path", { d: `M${cx - 2 * radius} ${cy}h${radius}m${2 * radius} 0h${radius}M${cx} ${cy - 2 * radius}v${radius}m0 ${2 * radius}v${radius}`, class: "star-ring" }));
  }
  byId("star").replaceChildren(...marks);
}
