// Wires the page: mouse, touch and keys change the model; every change is drawn, checked and, for marks, fitted anew.

import { Board } from "./board.js";
import { Model, hit, moved } from "./model.js";
import { ask, fetchMap, takeToken } from "./server.js";

const REACH = 14; // pixels of the screen within which a finger or mouse takes hold of something
const $ = (id) => document.getElementById(id);
const board = new Board($("frame"), $("picture"), $("board"));
let model = new Model([]);
let knownIds = new Set();
let drag = null, held = null, pinch = null, drawing = [], picked = null, proposal = null, hasCross = false;
let fitted = { key: "", residuals: [] };
let bad = new Set(), suspects = new Set(), checking = 0, fitting = 0;
const fingers = new Map();

const tool = () => document.querySelector("input[name=tool]:checked").value;
const say = (text) => { $("status").textContent = text; };

function redraw() {
  const state = drag ? preview() : model.state;
  board.draw(state, {
    picked: picked?.kind === "mark" ? null : picked?.index ?? null,
    bad, suspects, ghosts: proposal ? proposal.facets : [], drawing, hasCross,
    isNight: document.documentElement.dataset.mode === "night",
  });
  $("undo").disabled = !model.past.length;
  $("redo").disabled = !model.future.length;
  $("delete").disabled = !picked;
  $("unmark").disabled = !model.state.marks.length;
  $("solve").disabled = model.state.marks.length < 4;
  $("count").textContent = `${model.state.facets.length} outlines of ${knownIds.size} facets.`;
}

function list(element, texts) {
  element.replaceChildren(...texts.map(([text, isBad]) => {
    const item = document.createElement("li");
    item.textContent = text;
    if (isBad) item.className = "bad";
    return item;
  }));
}

async function changed({ fit = false } = {}) {
  $("saved").textContent = "";
  redraw();
  check();
  if (fit) await solve(true);
  else showMarks();
}

// The marks with their residuals, for as long as these are of the same marks.
function showMarks(residuals = null) {
  const key = JSON.stringify(model.state.marks);
  if (residuals) fitted = { key, residuals };
  const px = new Map(fitted.key === key ? fitted.residuals.map((r) => [r.id, r.px]) : []);
  list($("marks"), model.state.marks.map((m) => [
    `facet ${m.id}${px.has(m.id) ? `: ${px.get(m.id).toFixed(2)} px off` : ""}${suspects.has(m.id) ? ": look at this one" : ""}`,
    suspects.has(m.id),
  ]));
}

async function check() {
  const turn = ++checking;
  const found = await ask("check", { facets: model.state.facets });
  if (turn !== checking) return;
  if (found.error) { list($("faults"), [[found.error, true]]); return; }
  bad = new Set(found.faults.map((f) => f.id));
  list($("faults"), found.faults.flatMap((f) => f.texts.map((t) => [`Facet ${f.id}: ${t}.`, true])));
  $("leave").hidden = !found.missing.length;
  const shown = found.missing.slice(0, 20).join(", ") + (found.missing.length > 20 ? ` and ${found.missing.length - 20} more` : "");
  if (shown !== $("leave").dataset.ids) $("missing").checked = false;
  $("leave").dataset.ids = shown;
  $("missing-text").textContent = `Leave facets without an outline out: ${shown}`;
  redraw();
}

// Fits the outlines to the marks; `isAutomatic` waits in silence for the fourth mark.
async function solve(isAutomatic) {
  const turn = ++fitting;
  suspects = new Set();
  if (model.state.marks.length < 4) {
    showMarks();
    $("fit").textContent = isAutomatic ? `${4 - model.state.marks.length} more needed.` : "";
    list($("notes"), []);
    redraw();
    return;
  }
  const marks = model.state.marks;
  const found = await ask("solve", { facets: marks });
  if (turn !== fitting || marks !== model.state.marks) return;
  if (found.error) {
    suspects = new Set(found.ids);
    $("fit").textContent = found.error;
    list($("notes"), []);
    showMarks();
    redraw();
    return;
  }
  $("fit").textContent = `The marks fit with ${found.rms_px.toFixed(2)} px rms; the least certain facet is good to ${found.uncertainty_px.toFixed(1)} px.`;
  list($("notes"), found.notes.map((n) => [`Note: ${n}.`, false]));
  picked = null;
  const follow = (s) => { s.facets = found.facets; s.basis = "marks"; };
  if (isAutomatic) model.amend(follow);
  else model.change(follow);
  showMarks(found.residuals);
  redraw();
  check();
}

async function propose() {
  say("Looking for edges: this takes some seconds.");
  $("propose").disabled = true;
  const found = await ask("propose", { facets: model.state.marks });
  $("propose").disabled = false;
  if (found.error) { say(found.error); return; }
  proposal = found;
  $("proposal").hidden = false;
  const doubts = found.doubts.map((d) => [`Not trustworthy: ${d}.`, true]);
  list($("notes"), [...doubts, ...found.notes.map((n) => [`Note: ${n}.`, false])]);
  say(found.doubts.length ? "A proposal, but it cannot be trusted." : `Edges of ${Math.round(100 * found.seen_share)} % of the facets found.`);
  redraw();
}

function endProposal(isTaken) {
  if (proposal && isTaken) {
    const { facets } = proposal;
    picked = null;
    model.change((s) => { s.facets = facets; s.basis = "edges"; });
  }
  proposal = null;
  $("proposal").hidden = true;
  changed();
}

async function save() {
  $("saved").textContent = "Saving.";
  const { facets, basis } = model.state;
  const answer = await ask("save", { facets, basis, is_missing_confirmed: $("missing").checked && !$("leave").hidden });
  $("saved").textContent = answer.error ? `Not saved. ${answer.error}` : `Saved: ${answer.n_facets} outlines in ${answer.written}. ${answer.next}`;
}

function number() {
  const text = $("number").value.trim();
  return /^[0-9]{1,6}$/.test(text) ? Number(text) : null;
}

function freeNumber() {
  const id = number();
  if (id === null) { say("Type the facet's number first."); $("number").focus(); return null; }
  if (!knownIds.has(id)) { say(`This reflector has no facet ${id}.`); $("number").select(); return null; }
  return id;
}

// A click, wherever it comes from: mouse, finger or Enter on the cross.
function clickAt(place) {
  if (tool() === "mark") {
    const id = freeNumber();
    if (id === null) return;
    model.mark(id, [place]);
    say(`Facet ${id} marked at ${place.map((v) => v.toFixed(1)).join(", ")}.`);
    $("number").value = "";
    if (!hasCross) $("number").focus({ preventScroll: true });
    changed({ fit: true });
  } else if (tool() === "draw") {
    const isClosing = drawing.length >= 3 && Math.hypot(place[0] - drawing[0][0], place[1] - drawing[0][1]) < REACH / board.scale;
    if (!isClosing) drawing.push(place);
    else {
      const id = freeNumber();
      if (id === null) return;
      const points = drawing;
      drawing = [];
      model.change((s) => { s.facets.push({ id, points }); });
      say(`Facet ${id} drawn.`);
      changed();
      return;
    }
    say(`${drawing.length} corners; click the first one again to close the outline, Escape gives up.`);
    redraw();
  } else pick(hit(model.state, place, REACH / board.scale));
}

function pick(what) {
  picked = what;
  const item = what && (what.kind === "mark" ? model.state.marks : model.state.facets)[what.index];
  if (item) $("number").value = item.id;
  say(item ? `${what.kind === "mark" ? "Mark of facet" : what.kind === "corner" ? "Corner of facet" : "Facet"} ${item.id}.` : "");
  redraw();
}

function preview() {
  if (drag.kind === "view" || !drag.by) return model.state;
  const state = structuredClone(model.state);
  moved(state, drag.what, drag.by);
  return state;
}

function finish(what, by) {
  model.change((s) => { moved(s, what, by); });
  changed({ fit: what.kind === "mark" });
}

function remove() {
  if (!picked) return;
  const { kind, index, corner } = picked;
  model.change((s) => {
    if (kind === "mark") s.marks.splice(index, 1);
    else if (kind === "corner" && s.facets[index].points.length > 3) s.facets[index].points.splice(corner, 1);
    else s.facets.splice(index, 1);
  });
  picked = null;
  changed({ fit: kind === "mark" });
}

function renumber() {
  if (!picked) { say("Select an outline or a mark first."); return; }
  const id = freeNumber();
  if (id === null) return;
  const isMark = picked.kind === "mark";
  model.change((s) => { (isMark ? s.marks : s.facets)[picked.index].id = id; });
  changed({ fit: isMark });
}

// The corners of an outline tell more than one point: 4 facets marked so are as good as 20 marked centres.
function outlineToMark() {
  if (!picked || picked.kind === "mark") { say("Select an outline first."); return; }
  const { id, points } = model.state.facets[picked.index];
  model.mark(id, structuredClone(points));
  say(`Facet ${id} marked by its outline.`);
  changed({ fit: true });
}

function step(isBack) {
  if (isBack ? model.undo() : model.redo()) {
    picked = null;
    drawing = [];
    suspects = new Set();
    $("fit").textContent = "";
    say(isBack ? "Undone." : "Redone.");
    changed();
  }
}

function position(event) {
  const box = $("board").getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

$("board").addEventListener("pointerdown", (event) => {
  if (event.button > 1) return;
  hasCross = false;
  const at = position(event);
  fingers.set(event.pointerId, at);
  $("board").setPointerCapture(event.pointerId);
  if (fingers.size === 2) {
    drag = null;
    const [a, b] = [...fingers.values()];
    pinch = { apart: Math.hypot(a[0] - b[0], a[1] - b[1]), middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2] };
    return;
  }
  const found = hit(model.state, board.toPicture(...at), REACH / board.scale);
  const isTaken = found && (tool() === "move" || (tool() === "mark" && found.kind === "mark"));
  if (isTaken) pick(found);
  drag = { kind: isTaken ? "thing" : "view", what: found, from: at, last: at, by: null, hasMoved: false };
});

$("board").addEventListener("pointermove", (event) => {
  if (!fingers.has(event.pointerId)) return;
  const at = position(event);
  fingers.set(event.pointerId, at);
  if (pinch && fingers.size === 2) {
    const [a, b] = [...fingers.values()];
    const apart = Math.hypot(a[0] - b[0], a[1] - b[1]), middle = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    board.pan(middle[0] - pinch.middle[0], middle[1] - pinch.middle[1]);
    board.zoom(apart / Math.max(pinch.apart, 1), ...middle);
    pinch = { apart, middle };
    redraw();
    return;
  }
  if (!drag) return;
  if (Math.hypot(at[0] - drag.from[0], at[1] - drag.from[1]) > 3) drag.hasMoved = true;
  if (!drag.hasMoved) return;
  if (drag.kind === "view") board.pan(at[0] - drag.last[0], at[1] - drag.last[1]);
  else drag.by = [(at[0] - drag.from[0]) / board.scale, (at[1] - drag.from[1]) / board.scale];
  drag.last = at;
  redraw();
});

function release(event) {
  fingers.delete(event.pointerId);
  if (pinch) {
    if (!fingers.size) pinch = null;
    return;
  }
  const done = drag;
  drag = null;
  if (!done || event.type === "pointercancel") { redraw(); return; }
  if (done.kind === "thing" && done.by) finish(done.what, done.by);
  else if (!done.hasMoved && done.kind === "view") clickAt(board.toPicture(...done.from));
}
$("board").addEventListener("pointerup", release);
$("board").addEventListener("pointercancel", release);

$("board").addEventListener("wheel", (event) => {
  event.preventDefault();
  board.zoom(Math.exp(-event.deltaY / 400), ...position(event));
  redraw();
}, { passive: false });

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
$("board").addEventListener("keydown", (event) => {
  const arrow = ARROWS[event.key];
  if (arrow) {
    hasCross = true;
    const far = event.shiftKey ? 10 : 1;
    board.cursor = [board.cursor[0] + far * arrow[0], board.cursor[1] + far * arrow[1]];
    if (held) drag = { kind: "thing", what: held.what, by: [board.cursor[0] - held.from[0], board.cursor[1] - held.from[1]] };
    say(`Cross at ${board.cursor.map((v) => v.toFixed(0)).join(", ")}.`);
  } else if (event.key === "Enter") clickAt([...board.cursor]);
  else if (event.key === " " && held) {
    const { what, from } = held;
    held = drag = null;
    finish(what, [board.cursor[0] - from[0], board.cursor[1] - from[1]]);
  } else if (event.key === " ") {
    const what = hit(model.state, board.cursor, REACH / board.scale);
    if (what) { pick(what); held = { what, from: [...board.cursor] }; say("Taken up; arrows move it, Space puts it down."); }
  } else if (event.key === "Escape") { drawing = []; held = drag = null; say("Given up."); }
  else if (event.key === "+" || event.key === "-") board.zoom(event.key === "+" ? 1.25 : 0.8, ...board.toScreen(board.cursor));
  else return;
  event.preventDefault();
  redraw();
});

document.addEventListener("keydown", (event) => {
  if (event.target === $("number")) return;
  if ((event.key === "Delete" || event.key === "Backspace") && picked) { event.preventDefault(); remove(); }
  else if (event.ctrlKey && event.key.toLowerCase() === "z") { event.preventDefault(); step(!event.shiftKey); }
  else if (event.ctrlKey && event.key.toLowerCase() === "y") { event.preventDefault(); step(false); }
});

function setMode(mode) {
  document.documentElement.dataset.mode = mode;
  // as the live page does: a cookie, for cookies know no port, and the night is one for all pages
  document.cookie = `namod-mode=${mode}; max-age=31536000; path=/; samesite=strict`;
  $("mode").setAttribute("aria-pressed", String(mode === "night"));
  redraw();
}

const middle = () => [$("frame").clientWidth / 2, $("frame").clientHeight / 2];
const buttons = {
  undo: () => step(true), redo: () => step(false), delete: remove, renumber, save, propose, outline: outlineToMark,
  solve: () => solve(false),
  unmark: () => { model.change((s) => { s.marks = []; }); suspects = new Set(); $("fit").textContent = ""; changed(); },
  accept: () => endProposal(true), discard: () => endProposal(false),
  closer: () => { board.zoom(1.25, ...middle()); redraw(); },
  farther: () => { board.zoom(0.8, ...middle()); redraw(); },
  whole: () => { board.whole(); redraw(); },
  mode: () => setMode(document.documentElement.dataset.mode === "night" ? "day" : "night"),
};
for (const [id, act] of Object.entries(buttons)) $(id).addEventListener("click", act);
document.querySelectorAll("input[name=tool]").forEach((radio) => radio.addEventListener("change", () => { drawing = []; redraw(); }));
new ResizeObserver(() => { if (board.image) { if (board.isWhole) board.whole(); redraw(); } }).observe($("frame"));

takeToken();
$("mode").setAttribute("aria-pressed", String(document.documentElement.dataset.mode === "night"));
try {
  const map = await fetchMap();
  knownIds = new Set(map.ids);
  model = new Model(map.facets);
  $("title").textContent = `Facet map of ${map.telescope}: ${map.picture.name}`;
  const image = new Image();
  image.src = "/picture.png";
  await image.decode();
  board.show(image);
  say("Type a facet's number, then click its centre.");
  changed();
} catch (error) {
  say(`The page cannot start: ${error.message}`);
}
