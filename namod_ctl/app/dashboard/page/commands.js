// Commands: who has the token may give them. To stop is always in sight; that and to refuse need one confirmation.

import { byId, element, nextMessage, setText } from "./dom.js";

const WORDS = { pause: "Pause", resume: "Resume", approve: "Approve the correction", refuse: "Refuse: nothing moves, the campaign is held" };
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
  // whatever the page believes: it may be half a second late, and the program itself knows best
  byId("stop").onclick = () => confirm(stopInWords(), () => send({ kind: "stop" }));
  byId("stop-no").onclick = () => byId("stop-dialog").close();
}

const stopInWords = () => (isCampaign
  ? ["Stop everything?", "All drives halt at once. The campaign is held until somebody has looked at the telescope and releases it.", "Stop now"]
  : ["Stop the recording?", "The recording ends after the record in work. All its records are kept.", "Stop now"]);
const REFUSE_IN_WORDS = ["Refuse the correction?", "Nothing moves. The campaign is held: it goes on only when somebody says 'namod-ctl release' in a terminal.", "Refuse it"];

function confirm([title, means, yes], act) {
  const dialog = byId("stop-dialog");
  setText(byId("h-stop"), title);
  setText(byId("stop-means"), means);
  setText(byId("stop-yes"), yes);
  byId("stop-yes").onclick = () => {
    dialog.close();
    act();
  };
  dialog.showModal();
}

const seemsToStop = () => standing?.commands.includes("stop");

function showTokenForm() {
  byId("token-form").hidden = token !== "" || !standing?.commands.length;
}

export function showCommands(now) {
  standing = now;
  byId("stop").setAttribute("aria-disabled", String(!seemsToStop()));
  showTokenForm();
  const wanted = now.commands.filter((kind) => kind in WORDS);
  const group = byId("commands");
  if (group.dataset.kinds === wanted.join()) return; // a button that has the focus stays
  group.dataset.kinds = wanted.join();
  group.replaceChildren(...wanted.map((kind) => {
    const button = element("button", { type: "button", "data-kind": kind }, WORDS[kind]);
    const give = () => send({ kind, step: standing.step });
    button.addEventListener("click", kind === "refuse" ? () => confirm(REFUSE_IN_WORDS, give) : give);
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
