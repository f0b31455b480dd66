// Commands: who has the token may give them. To stop needs one confirmation and is always in sight.

import { byId, element, nextMessage, setText } from "./dom.js";

const WORDS = { pause: "Pause", resume: "Resume", approve: "Approve the correction", refuse: "Refuse it" };
const KEY = "namod-token";

let isCampaign = false;
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
  isCampaign = about.kind === "campaign";
  setText(byId("h-stop"), isCampaign ? "Stop everything?" : "Stop the recording?");
  setText(byId("stop-means"), isCampaign
    ? "All drives halt at once. The campaign is held until somebody has looked at the telescope and releases it."
    : "The recording ends after the record in work. All its records are kept.");
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
  byId("stop").onclick = () => (canStop() ? dialog.showModal() : say(whyNot()));
  byId("stop-no").onclick = () => dialog.close();
  byId("stop-yes").onclick = () => {
    dialog.close();
    send({ kind: "stop" });
  };
}

const canStop = () => standing?.commands.includes("stop");
const whyNot = () => (isCampaign ? "Nobody is at work on this campaign: there is nothing to stop." : "Nobody records this at the moment: there is nothing to stop.");

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

function say(text) {
  nextMessage(byId("reply"), text);
}

export async function send(order, reply = say) {
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
