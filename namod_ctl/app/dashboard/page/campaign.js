// The legs with their state, the correction that waits for approval, and the journal.

import { byId, element, number, setText } from "./dom.js";

const MAX_LEGS = 400;
const MAX_FACETS_NAMED = 12;

let shown = null; // what was last said of the actuators
let planned = new Map(); // travel in mm by facet and leg, of the correction that waits for approval

export const plannedTravel = ({ facet, leg }) => planned.get(`${facet}/${leg}`) ?? null;
const signed = (travel) => `${travel > 0 ? "+" : ""}${number(travel, 3)} mm`;
export const planInWords = (leg) => { const travel = plannedTravel(leg); return travel === null ? "" : `would go by ${signed(travel)}`; };

export function showPreview(preview) {
  planned = new Map((preview?.legs ?? []).map((leg) => [`${leg.facet}/${leg.leg}`, leg.travel_mm]));
  byId("preview").hidden = preview === null;
  if (shown) showActuators(shown);
  if (preview === null) return;
  const { question, largest, refused, area_now: now, area_predicted: predicted } = preview;
  const most = largest ? ` The farthest: leg ${largest.leg} of facet ${largest.facet} by ${signed(largest.travel_mm)}.` : "";
  const nRefused = refused.reduce((sum, { facets }) => sum + facets.length, 0);
  const stay = nRefused ? ` ${nRefused} ${nRefused === 1 ? "facet stays as it is" : "facets stay as they are"}:` : " No facet is left out.";
  setText(byId("preview-text"), `${question}.${most} Light of the whole reflector: ${number(now)} arcmin² now, ${number(predicted)} arcmin² predicted.${stay}`);
  byId("preview-refused").replaceChildren(...refused.map(({ why, facets }) => {
    const more = facets.length > MAX_FACETS_NAMED ? ` and ${facets.length - MAX_FACETS_NAMED} more` : "";
    return element("li", {}, `${facets.length === 1 ? "facet" : "facets"} ${facets.slice(0, MAX_FACETS_NAMED).join(", ")}${more}: ${why}`);
  }));
}

export function showActuators(actuators) {
  shown = actuators;
  const { cycle, counts, drives, legs } = actuators;
  byId("actuators-section").hidden = legs.length === 0;
  const listed = (found) => Object.entries(found).map(([what, n]) => `${n} ${what.replaceAll("_", " ")}`).join(", ");
  const ordered = cycle === null ? `${legs.length} legs, none was ordered to move yet.` : `Last orders in cycle ${cycle}: ${legs.length} legs, ${listed(counts)}.`;
  setText(byId("actuators-text"), Object.keys(drives).length ? `${ordered} Drives: ${listed(drives)}.` : ordered);
  const sorted = [...legs].sort((one, other) => other.is_bad - one.is_bad);
  byId("legs").replaceChildren(...sorted.slice(0, MAX_LEGS).map((leg) => element("tr", {},
    element("th", { scope: "row" }, String(leg.facet)),
    element("td", {}, String(leg.leg)),
    element("td", {}, leg.position_mm === null ? "?" : `${number(leg.position_mm, 3)} mm`),
    element("td", {}, leg.target_mm === null ? "–" : `${number(leg.target_mm, 3)} mm`),
    element("td", {}, plannedTravel(leg) === null ? "–" : signed(plannedTravel(leg))),
    element("td", leg.is_bad ? { class: "bad" } : {}, legState(leg)))));
}

export const legState = ({ outcome, detail, drive }) =>
  [outcome.replaceAll("_", " ") + (outcome && detail ? `: ${detail}` : ""), drive].filter((text) => text).join("; ");

export function showJournal(events) {
  byId("journal-section").hidden = events.length === 0;
  byId("journal").replaceChildren(...events.map((event) => {
    const time = new Date(event.time_utc);
    return element("li", {}, element("time", { datetime: event.time_utc }, time.toLocaleTimeString()), event.text);
  }));
}
