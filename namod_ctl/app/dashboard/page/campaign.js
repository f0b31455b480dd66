// The legs with their state, and the journal.

import { byId, element, number, setText } from "./dom.js";

const MAX_LEGS = 400;

export function showActuators({ cycle, counts, drives, legs }) {
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
