// Commands: who has the token may give them. To stop needs one confirmation and is always in sight.

import { byId, element, nextMessage, number, setText } from "./dom.js";

const WORDS = { pause: "Pause", resume: "Resume", approve: "Approve the correction", refuse: "Refuse it" };
const KEY = "namod-token";

let takesCommands = false;
let standing = null;
let token = "";

function stored(value) {
  try {
    if (value !== undefined) sessionStorage.setItem(KEY, value);
    return sessionStorage.getItem(KEY) ?? "";
  } catch {
    return value ?? "";
  }
}

export function setUpCommands(about) {
  takesCommands = about.takes_commands;
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  token = given ? stored(given) || given : token || stored();
  if (given) history.replaceState(null, "", location.pathname); // so that nobody reads it over a shoulder
  showTokenForm();
  byId("token-form").onsubmit = (event) => {
    event.preventDefault();
    token = byId("token").value.trim();
    stored(token);
    byId("token").value = "";
    showTokenForm();
  };
  const dialog = byId("stop-dialog");
  byId("stop").onclick = () => (canStop() ? dialog.showModal() : reply(whyNot()));
  byId("stop-no").onclick = () => dialog.close();
  byId("stop-yes").onclick = () => {
    dialog.close();
    send({ kind: "stop" });
  };
}

const canStop = () => takesCommands && standing?.commands.includes("stop");
const whyNot = () => (takesCommands ? "Nobody is at work on this campaign: there is nothing to stop." : "A plain recording takes no commands: press Ctrl-C in its terminal to end it.");

function showTokenForm() {
  byId("token-form").hidden = token !== "" || !standing?.commands.length;
}

export function showCommands(now) {
  standing = now;
  byId("stop").setAttribute("aria-disabled", String(!canStop()));
  showTokenForm();
  const wanted = now.commands.filter((kind) => kind in WORDS);
  const group = byId("commands");
  if (group.dataset.kinds === wanted.join()) return; // a button that has the focus stays
  group.dataset.kinds = wanted.join();
  group.replaceChildren(...wanted.map((kind) => {
    const button = element("button", { type: "button", "data-kind": kind }, WORDS[kind]);
    button.addEventListener("click", () => send({ kind, step: standing.step }));
    return button;
  }));
}

export function showTurns(now) {
  const left = now.turns.filter((turn) => !turn.is_done);
  byId("turns-section").hidden = now.turns.length === 0;
  setText(byId("turns-left"), `${now.turns.length - left.length} of ${now.turns.length} facets done.`);
  byId("turns").replaceChildren(...now.turns.map((turn) => {
    const turns = turn.turns_deg.map((degrees, i) => `bolt ${i + 1}: ${degrees > 0 ? "+" : ""}${number(degrees, 0)}°`).join(", ");
    const line = element("li", {}, element("span", {}, `Facet ${turn.id}: ${turns}`));
    if (turn.is_done) line.append(element("span", {}, "✓ done"));
    else if (now.commands.includes("done")) {
      const button = element("button", { type: "button", "aria-label": `facet ${turn.id} is done` }, "Done");
      button.addEventListener("click", () => send({ kind: "done", facets: [turn.id] }));
      line.append(button);
    }
    return line;
  }));
}

function reply(text) {
  nextMessage(byId("reply"), text);
}

async function send(order) {
  reply("asked");
  try {
    const answer = await fetch("/command", {
      method: "POST",
      headers: { "content-type": "application/json", "x-namod-token": token },
      body: JSON.stringify(order),
    });
    if (answer.status === 401) {
      token = "";
      stored("");
      showTokenForm();
    }
    const text = await answer.text();
    reply(answer.headers.get("content-type")?.startsWith("application/json") ? JSON.parse(text).text : text);
  } catch {
    reply("There is no connection: nothing was asked. Use the terminal, or the telescope's own emergency stop.");
  }
}
