// Votes that this browser keeps and the server does not have: refused ones, those of another dataset or round, and
// those of an earlier version of the page. Each kind is one line with its reason and what can be done about it.

import { draftOf } from "./drafts.js";
import { element } from "./guide.js";
import { post } from "./outbox.js";
import { elsewhere, kept, ofEarlierVersion } from "./storage.js";

const ASKED_AT_ONCE = 100;
const votesOf = (count) => `${count} vote${count === 1 ? "" : "s"}`;

export class UnsentVotes {
  // holder: an element. opened(id): shows an episode of the queue.
  constructor(holder, session, outbox, drafts, opened) {
    Object.assign(this, { holder, session, outbox, drafts, opened, known: {} });
    addEventListener("storage", () => this.refresh());
  }

  // Asks the server which episodes an earlier version's ids mean, then shows what there is.
  async start() {
    const { votes, drafts } = ofEarlierVersion(this.session);
    const ids = [...new Set([...votes.map(([, vote]) => vote.candidate), ...drafts.map(([, id]) => id)])];
    for (let i = 0; i < ids.length; i += ASKED_AT_ONCE) {
      const candidates = ids.slice(i, i + ASKED_AT_ONCE);
      const said = await post("api/adopt", { dataset: this.session.dataset, candidates }).catch(() => null);
      Object.assign(this.known, said?.episodes);
    }
    this.refresh();
  }

  refresh() {
    const lines = [...this.#refused(), ...this.#elsewhere(), ...this.#earlier()];
    this.holder.replaceChildren(...lines);
    this.holder.hidden = !lines.length;
  }

  #refused() {
    const reasons = new Map();
    for (const { vote, why } of this.outbox.refusals()) reasons.set(why, [...(reasons.get(why) || []), vote]);
    return [...reasons].map(([why, votes]) => {
      const uids = votes.map((vote) => vote.uid);
      const here = votes.find((vote) => this.session.queue.some((item) => item.id === vote.candidate));
      return this.#line(`${votesOf(votes.length)} refused by the server and kept in this browser: ${why}.`, votes, {
        ...(here && { "Show the episode": () => this.opened(here.candidate) }),
        "Send again": () => this.outbox.again(uids),
      }, () => this.outbox.discard(uids));
    });
  }

  #elsewhere() {
    return elsewhere(this.session).map(({ dataset, round, keys, votes }) => {
      const whose = dataset === this.session.dataset ? `round ${round}` : `another dataset (${dataset.slice(0, 8)})`;
      const text = `${votesOf(votes.length)} of ${whose}, not sent yet: kept in this browser until its page is opened here.`;
      return this.#line(text, votes, {}, () => keys.forEach((key) => localStorage.removeItem(key)));
    });
  }

  #earlier() {
    const { votes, drafts } = ofEarlierVersion(this.session);
    const open = (id) => this.session.queue.find((item) => item.id === this.known[id] && !item.vote);
    const mine = votes.filter(([, vote]) => open(vote.candidate));
    // Marks are no votes: those on episodes of other datasets say nothing here.
    const marks = drafts.filter(([, id]) => open(id));
    if (!votes.length && !marks.length) return [];
    const text = `An earlier version of this page kept ${votesOf(votes.length)} and marks on ${marks.length} `
      + `episode${marks.length === 1 ? "" : "s"} without saying of which dataset. ${mine.length + marks.length} of these `
      + "name an episode of this dataset that has no vote yet.";
    const all = [...votes.map(([, vote]) => vote), ...marks.map(([, id, draft]) => ({ candidate: id, ...draft }))];
    const taking = mine.length + marks.length ? { "They are of this dataset: take over": () => this.#adopt(mine, marks, open) } : {};
    const keys = [...votes, ...marks].map(([key]) => key);
    return [this.#line(text, all, taking, () => keys.forEach((key) => localStorage.removeItem(key)))];
  }

  #adopt(votes, marks, open) {
    for (const [key, id, draft] of marks) {
      this.drafts.keep(open(id).id, { ...draftOf(null), ...draft });
      localStorage.removeItem(key);
    }
    for (const [key, vote] of votes) {
      const item = open(vote.candidate);
      if (!item) continue; // a second vote on the same episode
      item.vote = { ...vote, candidate: item.id, dataset: this.session.dataset };
      this.session.latest = vote.uid;
      this.outbox.push(item.vote);
      const left = kept(key, []).filter(({ uid }) => uid !== vote.uid);
      if (left.length) localStorage.setItem(key, JSON.stringify(left));
      else localStorage.removeItem(key);
    }
    this.opened(null);
  }

  #line(text, votes, actions, discard) {
    const line = element("p");
    line.append(element("span", text));
    const act = (button, work) => button.addEventListener("click", () => { work(); this.refresh(); });
    for (const [name, work] of Object.entries(actions)) act(line.appendChild(element("button", name)), work);
    const save = element("button", "Export");
    save.addEventListener("click", () => this.#download(votes));
    const drop = element("button", "Discard…");
    drop.addEventListener("click", () => {
      const sure = element("button", "Really discard", { class: "sure" });
      act(sure, discard);
      drop.replaceWith(sure);
      sure.focus();
    });
    line.append(save, drop);
    return line;
  }

  #download(votes) {
    const { annotator, dataset } = this.session;
    const data = new Blob([JSON.stringify({ annotator, votes }, null, 1)], { type: "application/json" });
    const link = element("a", "", { href: URL.createObjectURL(data), download: `votes-${annotator}-${dataset.slice(0, 8)}.json` });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }
}
