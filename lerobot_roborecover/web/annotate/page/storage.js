// What the page keeps in the browser, by dataset, annotator and round. The origin, this machine and a port, is shared
// by every dataset that was ever served there: what belongs to another one is never sent here.

const ROOT = "roborecover/annotate";
const OLD = /^rr\/(.*)\/([^/]+)\/(\d+)\/(outbox|draft\/(.+))$/; // until 0.1: by the folder's name alone

export const shelf = (session) => `${ROOT}/${session.dataset}/${session.annotator}/${session.round}`;
export const guideRead = (session) => `${ROOT}/guide-read/${session.annotator}`;

// What is kept under a key; something else than JSON counts as nothing, and is left as it is.
export function kept(key, otherwise) {
  try {
    return JSON.parse(localStorage.getItem(key)) ?? otherwise;
  } catch {
    return otherwise;
  }
}

const keys = () => Array.from({ length: localStorage.length }, (_, i) => localStorage.key(i));

// Unsent and refused votes of this annotator in other datasets or rounds: [{dataset, round, keys, votes}].
export function elsewhere(session) {
  const found = new Map();
  for (const key of keys()) {
    const [first, second, dataset, annotator, round, kind] = key.split("/");
    const own = dataset === session.dataset && Number(round) === session.round;
    if (`${first}/${second}` !== ROOT || annotator !== session.annotator || own) continue;
    if (kind !== "outbox" && kind !== "refused") continue;
    const votes = kept(key, []).map((item) => (kind === "refused" ? item.vote : item));
    if (!votes.length) continue;
    const name = `${dataset}/${round}`;
    if (!found.has(name)) found.set(name, { dataset, round: Number(round), keys: [], votes: [] });
    found.get(name).keys.push(key);
    found.get(name).votes.push(...votes);
  }
  return [...found.values()];
}

// What an earlier version kept for this annotator and round, whichever dataset of that name it was for:
// {votes: [[key, vote]], drafts: [[key, id, draft]]}; ids are the candidates' own.
export function ofEarlierVersion(session) {
  const found = { votes: [], drafts: [] };
  for (const key of keys()) {
    const [, , annotator, round, kind, id] = key.match(OLD) || [];
    if (annotator !== session.annotator || Number(round) !== session.round) continue;
    if (kind === "outbox") {
      found.votes.push(...kept(key, []).map((vote) => [key, vote]));
    } else {
      const draft = kept(key, {});
      if (draft.step == null && !draft.stage && !draft.deviation && !draft.comment) continue;
      found.drafts.push([key, id, draft]);
    }
  }
  return found;
}
