// Talking with the program. The token comes in the address's fragment, which is never sent to any server.

const KEY = "namod-facets-token";

export function takeToken() {
  const given = location.hash.slice(1);
  if (given) {
    sessionStorage.setItem(KEY, given);
    history.replaceState(null, "", location.pathname);
  }
}

export async function fetchMap() {
  const answer = await fetch("/map");
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

// The program's answer; {error, ids} when it refuses or is gone.
export async function ask(what, message) {
  try {
    const answer = await fetch(`/${what}`, {
      method: "POST",
      headers: { "content-type": "application/json", "x-namod-token": sessionStorage.getItem(KEY) ?? "" },
      body: JSON.stringify(message),
    });
    if (answer.ok || answer.status === 422) return await answer.json();
    return { error: await answer.text(), ids: [] };
  } catch {
    return { error: "the program does not answer; is namod-ctl facets edit still running?", ids: [] };
  }
}
