// The annotation page: one episode at a time, everything on a key, every vote on disk before it counts as saved.

import { draftOf, Drafts } from "./drafts.js";
import { Frames } from "./frames.js";
import { element, fillGuide } from "./guide.js";
import { UnsentVotes } from "./unsentVotes.js";
import { listen } from "./keys.js";
import { Outbox, post } from "./outbox.js";
import { fillAbout, fillDiscussion, fillSuggestions } from "./panel.js";
import { Player } from "./player.js";
import { Plots } from "./plots.js";
import { Readout } from "./readout.js";
import { guideRead, shelf } from "./storage.js";

const $ = (id) => document.getElementById(id);

let session, outbox, drafts, plots, readout, player, kept;
let episode = null; // as the server describes it
let draft = draftOf(null);
let following = null; // frames of the episode after this one
let since = performance.now();
let opening = 0;
let onWay = { waiting: 0, why: "" }; // votes that are not on disk yet

const get = async (path) => {
  const answer = await fetch(path);
  const said = await answer.json();
  if (!answer.ok) throw new Error(said.error || `HTTP ${answer.status}`);
  return said;
};
const place = (id) => session.queue.findIndex((item) => item.id === id);
const say = (text) => { $("message").textContent = text; };

function keep() {
  if (!episode) return;
  if (!document.hidden) draft.seconds += Math.min((performance.now() - since) / 1000, 60);
  since = performance.now();
  draft.frame = player.frame;
  drafts.keep(episode.id, draft);
}

// -- marks ---------------------------------------------------------------------------------------------------

function mark() {
  plots.at({
    step: player.frame,
    point: draft.step,
    suggestions: (episode?.suggestions || []).map((s) => s.step),
  });
  $("cameras").classList.toggle("at-mark", draft.step === player.frame);
}

function showDraft() {
  $("mark").classList.toggle("set", draft.step !== null);
  $("marked").textContent = draft.step === null ? "mark the recovery point here" : `frame ${draft.step}`;
  for (const button of document.querySelectorAll(".choices button"))
    button.setAttribute("aria-pressed", draft[button.dataset.axis] === button.dataset.name);
  if ($("comment").value !== draft.comment) $("comment").value = draft.comment;
  const missing = [
    ...(draft.step === null ? ["point"] : []), ...(draft.stage ? [] : ["stage"]), ...(draft.deviation ? [] : ["type"]),
  ];
  $("submit").classList.toggle("ready", !missing.length);
  $("submit-text").textContent = missing.length ? "Save" : "Save, next episode";
  $("missing").textContent = missing.length ? `missing: ${missing.join(", ")}` : "";
  showState();
  mark();
}

// What becomes of the votes on their way; else whether this episode's marks are a vote.
function showState() {
  const { waiting, why } = onWay;
  const vote = episode?.vote;
  const same = vote && ["step", "stage", "deviation", "comment"].every((name) => draft[name] === draftOf(vote)[name]);
  $("saved").className = waiting && why ? "waiting" : same || waiting ? "" : "draft";
  $("saved").textContent = waiting && why ? `${waiting} not saved: ${why}; trying again` : waiting ? "saving…"
    : same ? "✓ saved" : vote ? "draft: the vote before stands" : "draft";
  $("saved").title = same || waiting ? "" : "Marks on this episode are no vote yet; they stay in this browser until you save.";
  $("all-saved").textContent = waiting ? `${waiting} of your votes are still on their way to the server: keep this page open.`
    : outbox.refusals().length ? "Some votes were refused by the server: see above the frames." : "All votes are on disk.";
}

function change(changes) {
  Object.assign(draft, changes);
  say("");
  showDraft();
  keep();
}

function point() {
  if (draft.step === player.frame) return change({ step: null });
  if (player.frame < episode.first_step)
    return say(`the recovery point can be frame ${episode.first_step} at the earliest: before it nothing was done`);
  change({ step: player.frame });
}

async function cast(vote) {
  keep();
  const whole = {
    uid: crypto.randomUUID(), dataset: session.dataset, candidate: episode.id, comment: draft.comment,
    seconds: Math.round(draft.seconds), ...vote,
  };
  try {
    outbox.push(whole);
  } catch (error) {
    return say(`not saved: this browser's storage takes nothing more (${error.message}); the marks are still here`);
  }
  drafts.drop(episode.id);
  session.queue[place(episode.id)].vote = whole;
  session.latest = whole.uid;
  progress();
  const from = place(episode.id);
  const order = [...session.queue.slice(from + 1), ...session.queue.slice(0, from)];
  const next = order.find((item) => !item.vote);
  episode = null;
  if (next) return open(next.id);
  await open(whole.candidate);
  $("finished").showModal();
}

function taken(vote) {
  const item = session.queue[place(vote.candidate)];
  if (item) item.onDisk = vote;
  session.latestOnDisk = vote.uid;
}

// The vote is kept and shown; the episode is as it was before it, with the vote's marks.
function refused(vote, why) {
  const item = session.queue[place(vote.candidate)];
  if (item && item.vote?.uid === vote.uid) {
    item.vote = item.onDisk;
    const open = episode?.id === item.id;
    if (open) {
      episode.vote = item.vote;
      draft = { ...draftOf(vote), frame: player.frame };
      fillAbout(episode, place(episode.id) + 1, session.guide.reasons);
      showDraft();
    }
    drafts.keep(item.id, open ? draft : draftOf(vote));
  }
  if (session.latest === vote.uid) session.latest = session.latestOnDisk;
  progress();
  kept.refresh();
  say(`a vote was refused and is kept: ${why}`);
}

function submit() {
  if (draft.step === null || !draft.stage || !draft.deviation) return say(`not saved: ${$("missing").textContent}`);
  return cast({ verdict: "recovery", step: draft.step, stage: draft.stage, deviation: draft.deviation });
}

function discard(reason) {
  if (reason === "temporary" && episode.human)
    return say("human-made: the later correction is its proof, not a reason to discard it");
  if (reason === "other" && !draft.comment.trim()) {
    $("comment").focus();
    return say("write the reason into the comment, then discard");
  }
  return cast({ verdict: "discard", reason, step: draft.step });
}

async function undo() {
  if (!session.latest) return say("there is nothing to undo");
  if (outbox.waiting().length) say("waiting for the server to have all votes first");
  await outbox.flush();
  if (!session.latest) return say("there is nothing to undo");
  try {
    const said = await post("api/undo", { uid: session.latest });
    session.latest = session.latestOnDisk = said.latest;
    const item = session.queue[place(said.undone.candidate)];
    progress();
    if (!item) return say("the vote taken back is on an episode that is not in this queue any more");
    item.vote = item.onDisk = said.vote;
    if (episode) keep();
    drafts.keep(item.id, draftOf(said.undone));
    episode = null;
    progress();
    await open(item.id);
    say("the vote on this episode is taken back");
  } catch (error) {
    say(error.message);
  }
}

async function reveal() {
  if (!episode.vote) return say("suggestions are shown once the episode has your vote");
  await outbox.flush();
  try {
    episode.suggestions = (await post("api/reveal", { candidate: episode.id })).suggestions;
    fillSuggestions(episode, (step) => player.go(step));
    $("suggestions").scrollIntoView({ block: "nearest" });
    mark();
  } catch (error) {
    say(error.message);
  }
}

// -- episodes ------------------------------------------------------------------------------------------------

function progress() {
  const done = session.queue.filter((item) => item.vote).length;
  $("done").textContent = done;
  $("total").textContent = session.queue.length;
  $("bar").max = session.queue.length;
  $("bar").value = done;
  $("undo").disabled = !session.latest;
}

async function open(id) {
  const mine = ++opening;
  if (episode) keep();
  player.pause();
  let info;
  for (;;) {
    try {
      info = await get(`api/episodes/${encodeURIComponent(id)}`);
      break;
    } catch (error) {
      if (mine !== opening) return;
      say(`cannot open the episode: ${error.message}; trying again`);
      await new Promise((done) => setTimeout(done, 1000));
    }
    if (mine !== opening) return;
  }
  if (mine !== opening) return;
  say("");
  // After a vote with a button the keys work again: the button loses the focus.
  if (document.activeElement?.closest("main")) document.activeElement.blur();
  // The server may not have a vote yet that is still on its way to it.
  info.vote = session.queue[place(id)].vote;
  episode = info;
  draft = drafts.recall(info.id, info.vote);
  since = performance.now();
  history.replaceState(null, "", `#${id}`);
  const frames = following?.id === id ? following : new Frames(info, session);
  frames.changed = (loaded, all) => { $("loading").textContent = loaded < all ? `loading ${Math.round((100 * loaded) / all)} %` : ""; };
  following = null;
  player.open(frames, draft.frame);
  fillAbout(info, place(id) + 1, session.guide.reasons);
  $("human").hidden = !info.human;
  $("temporary").disabled = info.human;
  plots.show(info);
  readout.show(info, (name) => plots.colour(name));
  showDraft();
  fillSuggestions(info, (step) => player.go(step));
  fillDiscussion(info.discussion, session.guide.reasons);
  document.body.dataset.episode = id;
  await player.show(player.frame);
  frames.look(player.frame, 1);
  await frames.load(player.frame);
  if (mine !== opening) return;
  frames.look(player.frame, 1);
  // The next one in line, so that it is there when this one is done.
  const after = session.queue.slice(place(id) + 1).find((item) => !item.vote);
  if (!after) return;
  const coming = await get(`api/episodes/${encodeURIComponent(after.id)}`).catch(() => null);
  if (!coming || mine !== opening) return;
  const ahead = (following = new Frames(coming, session));
  await ahead.load(0);
  if (following === ahead) document.body.dataset.ahead = coming.id;
}

function step(by) {
  const count = session.queue.length;
  return open(session.queue[(place(episode.id) + by + count) % count].id);
}

// -- keys ----------------------------------------------------------------------------------------------------

function openGuide() {
  player.pause();
  fillGuide($("guide-text"), session.guide);
  $("guide").showModal();
  $("guide").scrollTop = 0;
}

const KEYS = {
  ArrowLeft: (e) => player.move(e.shiftKey ? -10 : -1),
  ArrowRight: (e) => player.move(e.shiftKey ? 10 : 1),
  Home: () => player.go(0),
  End: () => player.go(Infinity),
  " ": () => player.play(),
  "[": () => player.faster(-1),
  "]": () => player.faster(1),
  r: point,
  j: () => draft.step !== null && player.go(draft.step),
  k: () => $("comment").focus(),
  Enter: submit,
  t: () => discard("temporary"),
  d: () => { player.pause(); $("reasons").showModal(); },
  u: undo,
  g: openGuide,
  n: () => step(1),
  b: () => step(-1),
  s: reveal,
};

function choices(holder, axis, items) {
  for (const item of items) {
    const choose = () => change({ [axis]: draft[axis] === item.name ? "" : item.name });
    const button = element("button", "", { "data-key": item.key, "data-axis": axis, "data-name": item.name, title: item.text });
    button.append(element("kbd", item.key.toUpperCase()), ` ${item.name}`);
    holder.append(button);
    KEYS[item.key] = choose;
  }
}

// -- start ---------------------------------------------------------------------------------------------------

function build() {
  document.title = `${session.annotator}: annotate`;
  $("who").textContent = `${session.annotator} · set ${session.dataset.slice(0, 8)}${session.round > 1 ? ` · discussion, round ${session.round}` : ""}`;
  choices($("stages"), "stage", session.guide.stages);
  choices($("types"), "deviation", session.guide.types);
  $("reason-list").append(...session.guide.reasons.map((reason, i) => {
    const button = element("button");
    button.append(element("kbd", i + 1), ` ${reason.text}`);
    button.addEventListener("click", () => because(i + 1));
    return button;
  }));
  $("cameras").append(...session.cameras.map((camera) => {
    const figure = element("figure");
    figure.append(element("canvas"), element("figcaption", session.camera_labels[camera]));
    return figure;
  }));
  plots = new Plots($("plots"), $("keys"), (step) => player.go(step));
  readout = new Readout($("readout"));
  player = new Player(session, { drew: (step) => { readout.at(step); mark(); }, failed: say });
}

function because(number) {
  const reason = session.guide.reasons[number - 1];
  if (!reason) return;
  $("reasons").close();
  discard(reason.name);
}

async function start() {
  session = await get("api/session");
  session.latestOnDisk = session.latest;
  for (const item of session.queue) item.onDisk = item.vote;
  drafts = new Drafts(`${shelf(session)}/draft`);
  build();
  outbox = new Outbox(shelf(session), {
    changed: (waiting, why) => {
      onWay = { waiting, why };
      showState();
      document.body.dataset.waiting = waiting;
    },
    taken,
    refused,
  });
  kept = new UnsentVotes($("kept"), session, outbox, drafts, (id) => {
    progress();
    const shown = id || episode?.id;
    episode = id ? episode : null; // what it was drawn with is not what is kept now
    if (shown) open(shown);
  });
  // Votes of an earlier visit that did not reach the server.
  for (const vote of outbox.waiting()) {
    const item = session.queue[place(vote.candidate)];
    if (item) { item.vote = vote; session.latest = vote.uid; }
  }
  outbox.flush();
  kept.start();
  progress();
  listen(KEYS, () => episode, because);
  document.addEventListener("visibilitychange", () => (document.hidden ? keep() : (since = performance.now())));
  addEventListener("pagehide", keep);
  $("comment").addEventListener("input", () => { draft.comment = $("comment").value; keep(); showState(); });
  $("close-guide").addEventListener("click", () => $("guide").close());
  $("guide").addEventListener("close", () => localStorage.setItem(guideRead(session), "yes"));
  if (!localStorage.getItem(guideRead(session))) {
    $("close-guide").textContent = "Begin";
    openGuide();
  }
  const wanted = decodeURIComponent(location.hash.slice(1));
  const first = session.queue.find((item) => !item.vote);
  await open(place(wanted) >= 0 ? wanted : (first || session.queue[0]).id);
}

start().catch((error) => {
  $("instruction").textContent = "The page cannot start";
  say(error.message);
});
