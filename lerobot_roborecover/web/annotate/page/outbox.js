// Votes on their way to the server. A vote is in the browser's storage until the server has said that it is on
// disk, and is sent again until then: neither a lost connection nor a restarted server loses or doubles one. One
// that the server refuses goes to those that are refused, and stays there until the annotator discards it.

import { kept } from "./storage.js";

const FIRST_WAIT_MS = 300;
const LONGEST_WAIT_MS = 5000;
// Refusals that pass by themselves: a token, a slow network, another address, too many requests.
const PASSING = [403, 408, 421, 429];

export async function post(path, body) {
  const answer = await fetch(path, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  });
  const said = await answer.json().catch(() => ({}));
  if (answer.ok) return said;
  const error = new Error(said.error || `HTTP ${answer.status}`);
  // This request will never be taken. What is not said by our own server may pass by itself, as all else.
  error.final = Boolean(said.error) && answer.status >= 400 && answer.status < 500 && !PASSING.includes(answer.status);
  throw error;
}

export class Outbox {
  // shelf: of localStorage. changed(waiting, why): how many votes are not on disk yet. taken(vote): it is on disk.
  // refused(vote, why): it never will be; it is among `refusals` from then on.
  constructor(shelf, { changed, taken, refused }) {
    Object.assign(this, { key: `${shelf}/outbox`, refusedKey: `${shelf}/refused`, changed, taken, refused });
    Object.assign(this, { running: null, waitMs: FIRST_WAIT_MS, why: "" });
    addEventListener("online", () => this.flush());
  }

  waiting() {
    return kept(this.key, []);
  }

  // [{vote, why}]
  refusals() {
    return kept(this.refusedKey, []);
  }

  push(vote) {
    localStorage.setItem(this.key, JSON.stringify([...this.waiting(), vote]));
    return this.flush();
  }

  // Sends refused votes once more.
  again(uids) {
    const chosen = this.refusals().filter(({ vote }) => uids.includes(vote.uid)).map(({ vote }) => vote);
    localStorage.setItem(this.key, JSON.stringify([...this.waiting(), ...chosen]));
    this.discard(uids);
    return this.flush();
  }

  // Forgets refused votes.
  discard(uids) {
    const left = this.refusals().filter(({ vote }) => !uids.includes(vote.uid));
    if (left.length) localStorage.setItem(this.refusedKey, JSON.stringify(left));
    else localStorage.removeItem(this.refusedKey);
  }

  // Resolves once nothing is waiting any more.
  flush() {
    this.running ??= this.#run().finally(() => { this.running = null; });
    return this.running;
  }

  async #run() {
    for (let votes = this.waiting(); votes.length; votes = this.waiting()) {
      this.changed(votes.length, this.why);
      const vote = votes[0];
      try {
        await post("api/votes", vote);
        this.#drop(vote);
        this.taken(vote);
        this.waitMs = FIRST_WAIT_MS;
        this.why = "";
      } catch (error) {
        if (error.final) {
          // First there, then not here: a page that is closed in between has it twice, and never not at all.
          const others = this.refusals().filter((item) => item.vote.uid !== vote.uid);
          localStorage.setItem(this.refusedKey, JSON.stringify([...others, { vote, why: error.message }]));
          this.#drop(vote);
          this.refused(vote, error.message);
          continue;
        }
        this.why = error.message;
        this.changed(votes.length, this.why);
        await new Promise((done) => setTimeout(done, this.waitMs));
        this.waitMs = Math.min(2 * this.waitMs, LONGEST_WAIT_MS);
      }
    }
    this.changed(0, "");
  }

  #drop(vote) {
    localStorage.setItem(this.key, JSON.stringify(this.waiting().filter((v) => v.uid !== vote.uid)));
  }
}
