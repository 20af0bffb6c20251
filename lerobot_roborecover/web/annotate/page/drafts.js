// Marks that are not votes yet, and the frame one was at: kept in the browser, so that they survive a reload.

const EMPTY = { step: null, stage: "", deviation: "", comment: "", frame: 0, seconds: 0 };

// What a vote would look like if it had not been cast yet; of no vote, an empty draft.
export function draftOf(vote) {
  if (!vote) return { ...EMPTY };
  // A vote that is still here, and not the server's answer, may lack what a discard does not have.
  const { step = null, stage = "", deviation = "", comment = "", seconds = 0 } = vote;
  return { ...EMPTY, step, stage, deviation, comment, seconds, frame: step ?? 0 };
}

export class Drafts {
  // key: of localStorage; an episode's id is added.
  constructor(key) {
    this.key = key;
  }

  keep(id, draft) {
    localStorage.setItem(`${this.key}/${id}`, JSON.stringify(draft));
  }

  drop(id) {
    localStorage.removeItem(`${this.key}/${id}`);
  }

  recall(id, vote) {
    const kept = localStorage.getItem(`${this.key}/${id}`);
    return kept ? { ...EMPTY, ...JSON.parse(kept) } : draftOf(vote);
  }
}
