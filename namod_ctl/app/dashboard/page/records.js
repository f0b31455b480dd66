// Counts, exposures, rate and rejections of the run that is recorded.

import { byId, element, number, setNumbers } from "./dom.js";

let lastWritten = 0; // by the clock of this device, ms
let ahead = 0; // of this device's clock, ms

export const setClock = (seconds) => { ahead = Date.now() - 1000 * seconds; };

export function showRecords(now) {
  lastWritten = 1000 * now.written_utc_s + ahead;
  const last = now.last;
  setNumbers(byId("numbers"), [
    ["run", now.name],
    ["records", `${now.n_accepted} count, ${now.n_rejected} rejected`],
    ["rate", now.rate_per_min === null ? "not known" : `${number(now.rate_per_min, 1)} per minute of the cameras`],
    ["recorded for", `${number((now.elapsed_s ?? 0) / 60, 1)} min`],
    ["last record", last === null ? "none yet" : `${last.index}: ${last.is_accepted ? "counts" : `rejected, ${last.why}`}`],
    ["written", ""],
    ["star", now.star],
    ["star exposure", exposure(now.star_exposure_s)],
    ["reflector exposure", exposure(now.reflector_exposure_s)],
    ["covered", now.coverage.share === null ? "not known" : `${Math.round(100 * now.coverage.share)} % of the region`],
  ]);
  byId("numbers").children[11].id = "age";
  showAge();
  const reasons = now.rejected.map((each) => element("li", {}, `${each.n} × ${each.reason}: ${each.meaning}`));
  byId("rejected").replaceChildren(...(reasons.length ? reasons : [element("li", {}, "none")]));
}

function showAge() {
  const place = byId("age");
  if (place === null) return;
  const age = Math.max(Date.now() - lastWritten, 0) / 1000;
  place.textContent = age < 120 ? `${Math.floor(age)} s ago` : new Date(lastWritten).toLocaleString();
}

const exposure = (seconds) => (seconds === null ? "not known" : seconds < 0.1 ? `${(1000 * seconds).toFixed(1)} ms` : `${seconds.toFixed(2)} s`);

setInterval(showAge, 1000); // this clock runs here: nothing is asked of the server
