// The legs with their state, and the journal.

import { byId, element, number, setText } from "./dom.js";

const MAX_LEGS = 400;
const GOOD = "arrived";

export function showActuators({ cycle, counts, legs }) {
  byId("actuators-section").hidden = legs.length === 0;
  const parts = Object.entries(counts).map(([outcome, n]) => `${n} ${outcome.replaceAll("_", " ")}`);
  setText(byId("actuators-text"), `Last orders in cycle ${cycle}: ${legs.length} legs, ${parts.join(", ")}.`);
  const sorted = [...legs].sort((one, other) => (one.outcome === GOOD) - (other.outcome === GOOD));
  byId("legs").replaceChildren(...sorted.slice(0, MAX_LEGS).map((leg) => {
    const state = leg.detail ? `${leg.outcome.replaceAll("_", " ")}: ${leg.detail}` : leg.outcome.replaceAll("_", " ");
    return element("tr", {},
      element("th", { scope: "row" }, String(leg.facet)),
      element("td", {}, String(leg.leg)),
      element("td", {}, leg.position_mm === null ? "?" : `${number(leg.position_mm, 3)} mm`),
      element("td", {}, `${number(leg.target_mm, 3)} mm`),
      element("td", leg.outcome === GOOD ? {} : { class: "bad" }, state));
  }));
}

export function showJournal(events) {
  byId("journal-section").hidden = events.length === 0;
  byId("journal").replaceChildren(...events.map((event) => {
    const time = new Date(event.time_utc);
    return element("li", {}, element("time", { datetime: event.time_utc }, time.toLocaleTimeString()), event.text);
  }));
}
