// Counts, exposures, rate and rejections of the run that is recorded, and what its recorder says beside its records.

import { byId, element, number, setNumbers, setText } from "./dom.js";

const SILENT_MS = 20000; // a recorder says something every 5 s

let lastWritten = 0; // by the clock of this device, ms
let ahead = 0; // of this device's clock, ms
let live = null;
let places = null;

export const setClock = (seconds) => { ahead = Date.now() - 1000 * seconds; };

export function showRecords(now) {
  places ??= makePlaces();
  lastWritten = 1000 * now.written_utc_s + ahead;
  live = now.live;
  const last = now.last;
  const rate = live?.rate_per_min ?? now.rate_per_min;
  setNumbers(byId("numbers"), [
    ["run", now.name],
    ["records", `${counted(now.n_accepted, live?.n_wanted ?? null)}, ${now.n_rejected} rejected`],
    ["rate", rate === null ? "not known" : `${number(rate, 1)} per minute of the cameras`],
    ["recorded for", `${number((now.elapsed_s ?? 0) / 60, 1)} min`],
    ["last record", last === null ? "none yet" : `${last.index}: ${last.is_accepted ? "counts" : `rejected, ${last.why}`}`],
    ["written", ""],
    ["star", now.star],
    ["star exposure", exposure(now.star_exposure_s) + limits("star")],
    ["reflector exposure", exposure(now.reflector_exposure_s) + limits("reflector")],
    ...(live !== null && live.longest_now_s !== null ? [["longest for the motion", exposure(live.longest_now_s)]] : []),
    ["covered", now.coverage.share === null ? "not known" : `${Math.round(100 * now.coverage.share)} % of the region`],
    ...(live?.estimate ? estimate(live.estimate) : []),
    ...(live === null ? [] : [[live.ended ? "ended" : "waits for", live.ended || live.waits_for]]),
  ]);
  const values = byId("numbers").querySelectorAll("dd");
  values[5].id = "age";
  places.waits = live !== null && !live.ended ? values[values.length - 1] : null;
  showAge();
  list(byId("rejected"), now.rejected.map((each) => `${each.n} × ${each.reason}: ${each.meaning}`));
  places.retakenSection.hidden = live === null;
  if (live === null) return;
  const missed = live.n_frames_missed ? [`${live.n_frames_missed} × frame counted by a camera that never came`] : [];
  list(places.retaken, [...live.retaken.map((each) => `${each.n} × ${each.cause}`), ...missed]);
}

function makePlaces() {
  const warning = element("p", { id: "warning", class: "banner", role: "status", hidden: "" });
  byId("numbers").before(warning);
  const retaken = element("ul", { id: "retaken", class: "plain" });
  const retakenSection = element("div", { hidden: "" }, element("h3", {}, "Taken again"), retaken);
  byId("rejected").after(retakenSection);
  return { warning, retaken, retakenSection, waits: null };
}

function showAge() {
  const place = byId("age");
  if (place === null) return;
  const age = Math.max(Date.now() - lastWritten, 0);
  place.textContent = age < 120000 ? `${Math.floor(age / 1000)} s ago` : new Date(lastWritten).toLocaleString();
  const isSilent = age > SILENT_MS;
  if (places.waits) setText(places.waits, isSilent ? "nobody knows: the recorder has said nothing for a while" : live.waits_for);
  const isWrong = live !== null && !live.ended && !isSilent;
  const wrong = isWrong ? live.warning || live.trouble : "";
  places.warning.hidden = !wrong;
  setText(places.warning, wrong && wrong[0].toUpperCase() + wrong.slice(1));
}

function list(place, lines) {
  place.replaceChildren(...(lines.length ? lines : ["none"]).map((line) => element("li", {}, line)));
}

function counted(n, wanted) {
  if (wanted === null) return `${n} count`;
  return n <= wanted ? `${n} of ${wanted}` : `${n}, ${wanted} wanted at least`; // gaps in the region are filled first
}

function limits(role) {
  const of = live?.exposure_limits_s[role];
  return of === undefined ? "" : ` (${of[0] ? exposure(of[0]) : "0"} to ${of[1] === null ? "any" : exposure(of[1])})`;
}

function estimate({ n_records: n, worst_arcmin: worst, worst_facet: facet, unseen, area_arcmin2: area, area_uncertainty_arcmin2: doubt }) {
  const dark = unseen.length === 0 ? "" : unseen.length > 8 ? `; ${unseen.length} facets not seen` : `; not seen: ${unseen.join(", ")}`;
  return [
    ["A_σ so far", area === null ? "not known" : `${number(area, 1)} ± ${number(doubt, 1)} arcmin² (${n} records)`],
    ["known worst", worst === null ? `no facet is known yet${dark}` : `facet ${facet}: ± ${number(worst)} arcmin${dark}`],
  ];
}

const exposure = (seconds) => (seconds === null ? "not known" : seconds < 0.1 ? `${(1000 * seconds).toFixed(1)} ms` : `${seconds.toFixed(2)} s`);

setInterval(showAge, 1000); // this clock runs here: nothing is asked of the server
