// The page: sections arrive as server-sent events, each goes to the module that draws it.

import { showActuators, showJournal, showPreview } from "./campaign.js";
import { setUpCommands, showCommands } from "./commands.js";
import { showCoverage } from "./coverage.js";
import { showCycles } from "./cycles.js";
import { byId, isNight, nextMessage, setText } from "./dom.js";
import { refreshFacet, setUpFacet, showFacetDetails } from "./facet.js";
import { setUpMirror, showFacets, showMirrorPicture } from "./mirror.js";
import { showPsf } from "./psf.js";
import { setClock, showRecords } from "./records.js";
import { setUpSheet, showMarks, showSheets } from "./sheet.js";
import { setUpStar, showStar } from "./star.js";

const known = {};

const draw = {
  clock: setClock,
  about(about) {
    setText(byId("title"), `${about.telescope}: ${about.name}`);
    document.title = `${about.telescope} ${about.name}`;
    setText(byId("about"), `${about.source}. namod-ctl ${about.version}.`);
    setUpMirror(about);
    setUpFacet(about);
    setUpStar(about);
    setUpCommands(about);
    setUpSheet(about);
  },
  standing(standing) {
    const before = byId("state").textContent;
    const state = standing.state.replaceAll("_", " ") + (standing.kind === "campaign" && !standing.is_running ? " (nobody at work)" : "");
    setText(byId("state"), state);
    setText(byId("meaning"), standing.meaning);
    setText(byId("reason"), standing.reason ? `Because: ${standing.reason}` : "");
    setText(byId("next"), standing.next);
    if (state !== before) nextMessage(byId("spoken"), `${state}. Next: ${standing.next}`);
    showCommands(standing);
    showMarks(standing);
    if (known.now) showCoverage(known.now, standing);
    showFacetDetails(known);
  },
  now(now) {
    showRecords(now);
    showCoverage(now, known.standing);
    showStar(now);
    showMirrorPicture(now);
    refreshFacet(known);
  },
  facets(facets) {
    showFacets(facets);
    showFacetDetails(known);
  },
  psf: showPsf,
  cycles: showCycles,
  actuators(actuators) {
    showActuators(actuators);
    showFacetDetails(known);
  },
  preview(preview) {
    showPreview(preview);
    showFacetDetails(known);
  },
  journal: showJournal,
  sheets: showSheets,
  trouble(text) {
    showBanner(text);
  },
};

function receive(name, text) {
  known[name] = JSON.parse(text);
  draw[name](known[name]);
  document.documentElement.dataset.updated = String(performance.now());
}

function showBanner(text) {
  byId("banner").hidden = !text;
  setText(byId("banner"), text);
}

function howToLookAgain() {
  if (!known.about) return ""; // a page beside a recording ends with it, and what was recorded stays to be seen
  const name = known.about.name;
  return ` To look again: namod-ctl dashboard ${/^[\w.-]+$/.test(name) ? name : `'${name.replaceAll("'", "'\\''")}'`}`;
}

function listen() {
  const source = new EventSource("/events");
  for (const name of Object.keys(draw)) source.addEventListener(name, (event) => receive(name, event.data));
  source.onopen = () => showBanner("");
  source.onerror = () => {
    showBanner(`No connection to the page's program: what stands here is old. Trying again.${howToLookAgain()}`);
    if (source.readyState === EventSource.CLOSED) setTimeout(listen, 2000);
  };
}

function setUpMode() {
  const button = byId("mode");
  const show = () => button.setAttribute("aria-pressed", String(isNight()));
  show();
  button.addEventListener("click", () => {
    document.documentElement.dataset.mode = isNight() ? "day" : "night";
    // a cookie, for cookies know no port: `--dashboard` takes another one every night
    document.cookie = `namod-mode=${document.documentElement.dataset.mode}; max-age=31536000; path=/; samesite=strict`;
    show();
    for (const [name, value] of Object.entries(known)) if (!["about", "standing", "clock", "sheets"].includes(name)) draw[name](value);
  });
}

setUpMode();
listen();
