// The work sheet: facet by facet in the order of the ladder, with check-off and undo while the campaign waits for it.

import { boltLine, drawFacet, drawMirror, inWords } from "./bolts.js";
import { send } from "./commands.js";
import { byId, element, nextMessage, setText } from "./dom.js";

const WORDS = { turn: "to turn", "no turn needed": "ok: no turn needed", "do not turn": "DO NOT TURN any bolt of this facet", "no bolts": "no bolts: its legs are driven" };

let standing = null;
let offered = []; // sheets there are: {key, fingerprint}
let key = null;
let fetched = ""; // key and fingerprint of the sheet that is shown, or asked for
let sheet = null;
let facets = []; // of the sheet, in the order of work
let chosen = null; // facet id
let places = new Map(); // facet id -> {node, tick} of the map and {button} of the list
let isCampaign = true;
let markChosen = () => {};
let buttonsOf = null; // the facet that Done and Undo were last shown for
const REST_MS = 1500; // a second tap on Done, however slow, takes no mark back

export function setUpSheet(about) {
  isCampaign = about.kind === "campaign";
  byId("sheet-choice").onchange = () => { key = Number(byId("sheet-choice").value); ask(); };
  byId("sheet-before").onclick = () => step(-1);
  byId("sheet-after").onclick = () => step(1);
  byId("sheet-next").onclick = () => choose(nextToDo());
  for (const [id, kind] of [["sheet-done", "done"], ["sheet-undo", "not_done"]]) {
    byId(id).onclick = () => { if (byId(id).ariaDisabled !== "true") send({ kind, facets: [chosen], step: standing.step }, reply); };
  }
}

// a button that takes another one's place under the finger does nothing at first
function letRest(button) {
  button.ariaDisabled = "true";
  clearTimeout(button.rest);
  button.rest = setTimeout(() => { button.ariaDisabled = "false"; }, REST_MS);
}

const reply = (text) => nextMessage(byId("sheet-reply"), text);

export function showSheets(found) {
  const newest = found.at(-1)?.key ?? null;
  if (newest !== (offered.at(-1)?.key ?? null) || !found.some((each) => each.key === key)) key = newest;
  offered = found;
  const choice = byId("sheet-choice");
  choice.replaceChildren(...found.map((each) => element("option", { value: each.key }, isCampaign ? `cycle ${each.key}` : "this run")));
  choice.value = String(key);
  ask();
}

async function ask() {
  const wanted = offered.find((each) => each.key === key);
  byId("sheet-section").hidden = !wanted;
  if (!wanted || fetched === `${wanted.key} ${wanted.fingerprint}`) return;
  fetched = `${wanted.key} ${wanted.fingerprint}`;
  const mine = fetched;
  try {
    const answer = await fetch(`/sheet/${wanted.key}`);
    if (mine !== fetched) return;
    if (!answer.ok) throw new Error(String(answer.status));
    sheet = await answer.json();
    build();
  } catch {
    if (mine === fetched) fetched = ""; // the banner tells of no connection; it is asked again when that is back
  }
}

function build() {
  facets = sheet.sheets.flatMap((each) => each.facets.map((facet) => ({ ...facet, place: each.name })));
  setText(byId("sheet-side"), `${sheet.side}.`);
  setText(byId("sheet-stand"), sheet.stand);
  const { nodes, mark } = drawMirror(byId("sheet-map"), facets, sheet.others, choose);
  setText(byId("sheet-key"), `${sheet.side}. Arrows: the way to turn, looking at the bolt. ${sheet.senses} ✓: done. Dashed: do not turn.`);
  markChosen = mark;
  places = new Map();
  byId("sheet-list").replaceChildren(...sheet.sheets.flatMap((each) => {
    const buttons = each.facets.map((facet) => {
      const button = element("button", { type: "button", class: "chip" });
      button.addEventListener("click", () => choose(facet.id));
      places.set(facet.id, { ...nodes.get(facet.id), button });
      return button;
    });
    return [element("h3", {}, each.name), element("div", { class: "chips" }, ...buttons)];
  }));
  const most = Math.max(0, ...facets.map((facet) => facet.bolts.length));
  const bolts = Array.from({ length: most }, (_, i) => i);
  byId("sheet-table-head").replaceChildren(element("tr", {}, ...["Facet", ...bolts.map((i) => `Bolt ${i + 1}`), "State"].map((text) => element("th", { scope: "col" }, text))));
  byId("sheet-table").replaceChildren(...facets.map((facet) => {
    const place = places.get(facet.id);
    place.cell = element("td", {});
    const cells = bolts.map((i) => element("td", {}, facet.bolts[i] ? `${facet.bolts[i].turn} ${facet.bolts[i].sense}` : "–"));
    return element("tr", {}, element("th", { scope: "row" }, String(facet.id)), ...cells, place.cell);
  }));
  if (!places.has(chosen)) chosen = null;
  chosen = isToDo(facetOf(chosen)) ? chosen : nextToDo() ?? chosen ?? facets[0]?.id ?? null;
  show();
}

const facetOf = (id) => facets.find((facet) => facet.id === id);
const isLive = () => standing?.turns_of === key && isCampaign;
const canMark = () => isLive() && standing.commands.includes("done");
const done = () => new Set(isLive() ? standing.turns.filter((turn) => turn.is_done).map((turn) => turn.id) : sheet.done);
const isToDo = (facet) => facet?.verdict === "turn" && !done().has(facet.id);

function nextToDo() {
  const from = facets.findIndex((facet) => facet.id === chosen) + 1;
  return [...facets.slice(from), ...facets.slice(0, from)].find(isToDo)?.id ?? null;
}

function step(by) {
  const at = facets.findIndex((facet) => facet.id === chosen) + by;
  if (facets[at]) choose(facets[at].id);
}

function choose(id) {
  if (id === null || id === chosen) return;
  chosen = id;
  reply("");
  show();
  byId("sheet-facet").scrollIntoView({ block: "nearest" });
  const facet = facetOf(id);
  nextMessage(byId("spoken"), `Facet ${id}, ${facet.place}: ${inWords(facet)}`);
}

export function showMarks(now) {
  standing = now;
  const [section, main] = [byId("sheet-section"), byId("main")];
  // what people work from comes first while they work
  const isFirst = main.firstElementChild === section;
  if (now.commands.includes("done") !== isFirst) isFirst ? main.append(section) : main.prepend(section);
  if (sheet) show();
}

function show() {
  const facet = facetOf(chosen);
  if (!facet) return;
  const marked = done();
  const turned = facets.filter((each) => each.verdict === "turn");
  const left = turned.filter((each) => !marked.has(each.id));
  for (const each of facets) showPlace(each, marked);
  setText(byId("sheet-left"), isCampaign ? `${turned.length - left.length} of ${turned.length} facets done` : `${turned.length} facets to turn`);
  setText(byId("sheet-facet"), `Facet ${facet.id}`);
  setText(byId("sheet-place"), facet.place);
  setText(byId("sheet-state"), marked.has(facet.id) ? "✓ done" : WORDS[facet.verdict]);
  byId("sheet-state").dataset.verdict = facet.verdict;
  markChosen(facet);
  drawFacet(byId("sheet-picture"), facet);
  byId("sheet-bolts").replaceChildren(...facet.bolts.map(boltLine));
  const notes = [...facet.notes.map((note) => `Note: ${note}`), ...(facet.why ? [facet.why] : [])];
  if (canMark() && left.length === 1 && left[0] === facet) notes.push("This is the last one. When it is marked, the telescope is recorded again and no mark can be taken back.");
  byId("sheet-notes").replaceChildren(...notes.map((text) => element("li", {}, text)));
  showButtons(facet, marked, left);
}

function showButtons(facet, marked, left) {
  const [yes, no, next] = [byId("sheet-done"), byId("sheet-undo"), byId("sheet-next")];
  const isAsked = canMark() && standing.turns.some((turn) => turn.id === facet.id);
  setText(yes, `Done: facet ${facet.id} is turned`);
  setText(no, `Undo: facet ${facet.id} is not done`);
  next.hidden = !canMark() || !left.some((each) => each !== facet);
  const held = document.activeElement;
  const wasHidden = new Map([yes, no].map((button) => [button, button.hidden]));
  yes.hidden = !isAsked || marked.has(facet.id);
  no.hidden = !isAsked || !marked.has(facet.id);
  for (const [button, other] of [[yes, no], [no, yes]]) {
    if (buttonsOf !== facet.id) button.ariaDisabled = "false";
    else if (wasHidden.get(button) && !button.hidden && !wasHidden.get(other)) letRest(button);
  }
  buttonsOf = facet.id;
  if (held === yes && yes.hidden) (next.hidden ? no : next).focus();
  else if (held === no && no.hidden && !yes.hidden) yes.focus();
  const at = facets.indexOf(facet);
  byId("sheet-before").setAttribute("aria-disabled", String(at === 0));
  byId("sheet-after").setAttribute("aria-disabled", String(at === facets.length - 1));
}

function showPlace(facet, marked) {
  const { node, tick, button, cell } = places.get(facet.id);
  const isDone = marked.has(facet.id);
  const words = isDone ? "done" : WORDS[facet.verdict];
  const kind = isDone ? "is-done" : { turn: "to-do", "do not turn": "forbidden" }[facet.verdict] ?? "as-it-is";
  node.setAttribute("class", `mirror-edge ${kind}`);
  setText(tick, isDone ? "✓" : "");
  setText(button, `${facet.id}${{ "is-done": " ✓", forbidden: " ✕", "as-it-is": " ok" }[kind] ?? ""}`);
  button.setAttribute("aria-label", `facet ${facet.id}: ${words}`);
  button.setAttribute("aria-current", String(facet.id === chosen));
  button.dataset.kind = kind;
  setText(cell, isDone ? "✓ done" : words);
  button.title = inWords(facet);
}
