// The annotation page: one episode at a time, everything on a key, every vote on disk before it counts as saved.

import { draftOf, Drafts } from "./drafts.js";
import { Frames } from "./frames.js";
import { element, fillGuide } from "./guide.js";
import { Outbox, post } from "./outbox.js";
import { fillDiscussion, fillSuggestions } from "./panel.js";
import { Plots } from "./plots.js";
import { Readout } from "./readout.js";

const $ = (id) => document.getElementById(id);
const SPEEDS = [0.25, 0.5, 1, 2, 4];

let session, outbox, drafts, plots, readout;
let episode = null; // as the server describes it
let draft = draftOf(null);
let frames = null;
let following = null; // frames of the episode after this one
let shown = -1;
let speed = 2;
let playing = 0;
let since = performance.now();
let opening = 0;

const get = async (path) => {
  const answer = await fetch(path);
  const said = await answer.json();
  if (!answer.ok) throw new Error(said.error || `HTTP ${answer.status}`);
  return said;
};
const store = () => `rr/${session.dataset}/${session.annotator}/${session.round}`;
const place = (id) => session.queue.findIndex((item) => item.id === id);
const say = (text) => { $("message").textContent = text; };

function keep() {
  if (!episode) return;
  if (!document.hidden) draft.seconds += Math.min((performance.now() - since) / 1000, 60);
  since = performance.now();
  drafts.keep(episode.id, draft);
}

// -- frames --------------------------------------------------------------------------------------------------

async function show(step) {
  const own = frames;
  step = Math.min(Math.max(step, 0), episode.steps - 1);
  const direction = step < draft.frame ? -1 : 1;
  draft.frame = step;
  let bitmaps = own.now(step);
  if (!bitmaps) {
    try {
      bitmaps = await own.at(step);
    } catch (error) {
      if (own === frames) say(`frame ${step}: ${error.message}`);
      return;
    }
    // Meanwhile one may have gone on, or elsewhere.
    if (own !== frames || draft.frame !== step) return;
  }
  session.cameras.forEach((camera, i) => {
    const canvas = $("cameras").children[i].firstChild;
    if (canvas.width !== bitmaps[i].width) canvas.width = bitmaps[i].width;
    if (canvas.height !== bitmaps[i].height) canvas.height = bitmaps[i].height;
    canvas.getContext("2d").drawImage(bitmaps[i], 0, 0);
    canvas.dataset.step = step;
    canvas.dataset.episode = own.id;
  });
  shown = step;
  $("frame").textContent = `${step} / ${episode.steps - 1}`;
  $("time").textContent = `${(step / session.fps).toFixed(2)} s`;
  readout.at(step);
  mark();
  document.dispatchEvent(new CustomEvent("frameshown", { detail: step }));
  own.look(step, direction);
}

function move(by) {
  pause();
  show(draft.frame + by);
}

function play() {
  if (playing) return pause();
  if (draft.frame >= episode.steps - 1) show(0);
  let last = performance.now(), owed = 0;
  const tick = (now) => {
    owed += ((now - last) / 1000) * session.fps * SPEEDS[speed];
    last = now;
    // A frame that has not arrived yet is waited for, never skipped over unseen at normal speed.
    while (owed >= 1 && shown === draft.frame && draft.frame < episode.steps - 1) {
      owed -= 1;
      show(draft.frame + 1);
    }
    owed = Math.min(owed, 8);
    if (draft.frame >= episode.steps - 1) return pause();
    playing = requestAnimationFrame(tick);
  };
  playing = requestAnimationFrame(tick);
  $("play").classList.add("on");
}

function pause() {
  cancelAnimationFrame(playing);
  playing = 0;
  $("play").classList.remove("on");
}

// -- marks ---------------------------------------------------------------------------------------------------

function mark() {
  plots.at({
    step: draft.frame,
    point: draft.step,
    suggestions: (episode.suggestions || []).map((s) => s.step),
  });
  $("cameras").classList.toggle("at-mark", draft.step === draft.frame);
}

function showDraft() {
  $("mark").classList.toggle("set", draft.step !== null);
  $("marked").textContent = draft.step === null ? "mark this frame" : `frame ${draft.step}`;
  for (const button of document.querySelectorAll(".choices button"))
    button.setAttribute("aria-pressed", draft[button.dataset.axis] === button.dataset.name);
  if ($("comment").value !== draft.comment) $("comment").value = draft.comment;
  const missing = [
    ...(draft.step === null ? ["point"] : []), ...(draft.stage ? [] : ["stage"]), ...(draft.deviation ? [] : ["type"]),
  ];
  $("submit").classList.toggle("ready", !missing.length);
  $("submit-text").textContent = missing.length ? `Save (missing: ${missing.join(", ")})` : "Save, next episode";
  mark();
}

function change(changes) {
  Object.assign(draft, changes);
  say("");
  showDraft();
  keep();
}

function point() {
  if (draft.step === draft.frame) return change({ step: null });
  if (draft.frame < episode.first_step)
    return say(`the recovery point can be frame ${episode.first_step} at the earliest: before it nothing was done`);
  change({ step: draft.frame });
}

async function cast(vote) {
  keep();
  const whole = {
    uid: crypto.randomUUID(), candidate: episode.id, comment: draft.comment, seconds: Math.round(draft.seconds), ...vote,
  };
  drafts.drop(episode.id);
  session.queue[place(episode.id)].vote = whole;
  session.latest = whole.uid;
  outbox.push(whole);
  progress();
  const from = place(episode.id);
  const order = [...session.queue.slice(from + 1), ...session.queue.slice(0, from)];
  const next = order.find((item) => !item.vote);
  episode = null;
  if (next) return open(next.id);
  await open(whole.candidate);
  $("finished").showModal();
}

function submit() {
  if (draft.step === null || !draft.stage || !draft.deviation) return say($("submit-text").textContent.replace("Save (", "Not saved ("));
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
  try {
    const said = await post("api/undo", { uid: session.latest });
    session.latest = said.latest;
    session.queue[place(said.undone.candidate)].vote = said.vote;
    if (episode) keep();
    drafts.keep(said.undone.candidate, draftOf(said.undone));
    episode = null;
    progress();
    await open(said.undone.candidate);
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
    fillSuggestions(episode, show);
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
  pause();
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
  // The server may not have a vote yet that is still on its way to it.
  info.vote = session.queue[place(id)].vote;
  episode = info;
  draft = drafts.recall(info.id, info.vote);
  since = performance.now();
  history.replaceState(null, "", `#${id}`);
  frames?.stop();
  frames = following?.id === id ? following : new Frames(info, session);
  frames.changed = (loaded, all) => { $("loading").textContent = loaded < all ? `loading ${Math.round((100 * loaded) / all)} %` : ""; };
  following = null;
  shown = -1;
  const vote = info.vote;
  const state = !vote ? "" : vote.verdict === "discard" ? ` · your vote: discard (${vote.reason})`
    : ` · your vote: frame ${vote.step}, ${vote.stage}, ${vote.deviation}`;
  $("instruction").textContent = info.instruction;
  $("about").textContent = `${place(id) + 1}. ${info.task} · ${info.steps} frames · ends ${info.solved_at_end ? "solved" : "unsolved"}${state}`;
  $("human").hidden = !info.human;
  $("temporary").disabled = info.human;
  plots.show(info);
  readout.show(info, (name) => plots.colour(name));
  showDraft();
  fillSuggestions(info, show);
  fillDiscussion(info.discussion);
  $("frame").textContent = `… / ${info.steps - 1}`;
  document.body.dataset.episode = id;
  await show(draft.frame);
  frames.look(draft.frame, 1);
  await frames.load(draft.frame);
  if (mine !== opening) return;
  frames.look(draft.frame, 1);
  // The next one in line, so that it is there when this one is done.
  const after = session.queue.slice(place(id) + 1).find((item) => !item.vote);
  if (!after) return;
  const coming = await get(`api/episodes/${encodeURIComponent(after.id)}`).catch(() => null);
  if (!coming || mine !== opening) return;
  following = new Frames(coming, session);
  following.load(0);
}

function step(by) {
  const count = session.queue.length;
  return open(session.queue[(place(episode.id) + by + count) % count].id);
}

// -- keys ----------------------------------------------------------------------------------------------------

function setSpeed(by) {
  speed = Math.min(Math.max(speed + by, 0), SPEEDS.length - 1);
  $("speed").textContent = `× ${SPEEDS[speed]}`;
}

const KEYS = {
  ArrowLeft: (e) => move(e.shiftKey ? -10 : -1),
  ArrowRight: (e) => move(e.shiftKey ? 10 : 1),
  Home: () => move(-Infinity),
  End: () => move(Infinity),
  " ": play,
  "[": () => setSpeed(-1),
  "]": () => setSpeed(1),
  r: point,
  j: () => draft.step !== null && move(draft.step - draft.frame),
  k: () => $("comment").focus(),
  Enter: submit,
  t: () => discard("temporary"),
  d: () => { pause(); $("reasons").showModal(); },
  u: undo,
  g: () => { pause(); fillGuide($("guide-text"), session.guide); $("guide").showModal(); },
  n: () => step(1),
  b: () => step(-1),
  s: reveal,
};

function pressed(event) {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (event.target === $("comment")) {
    if (key === "Escape") { event.preventDefault(); $("comment").blur(); }
    return;
  }
  const open = document.querySelector("dialog[open]");
  if (open) {
    if (open.id === "guide" && key === "g") open.close();
    if (open.id === "reasons") {
      const reason = session.guide.reasons[Number(key) - 1];
      if (reason) { open.close(); discard(reason.name); }
    }
    if (/^[0-9a-z ]$/.test(key)) event.preventDefault();
    return;
  }
  if (!episode || !KEYS[key] || (event.repeat && !key.startsWith("Arrow"))) return;
  event.preventDefault();
  KEYS[key](event);
}

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

async function start() {
  session = await get("api/session");
  drafts = new Drafts(`${store()}/draft`);
  document.title = `${session.annotator}: annotate ${session.dataset}`;
  $("who").textContent = `${session.annotator} · ${session.dataset}${session.round > 1 ? ` · discussion, round ${session.round}` : ""}`;
  choices($("stages"), "stage", session.guide.stages);
  choices($("types"), "deviation", session.guide.types);
  $("reason-list").append(...session.guide.reasons.map((reason, i) => {
    const button = element("button");
    button.append(element("kbd", i + 1), ` ${reason.text}`);
    button.addEventListener("click", () => { $("reasons").close(); discard(reason.name); });
    return button;
  }));
  $("cameras").append(...session.cameras.map((camera) => {
    const figure = element("figure");
    figure.append(element("canvas"), element("figcaption", camera.replace("observation.images.", "").replace("observation.", "")));
    return figure;
  }));
  plots = new Plots($("plots"), $("legend"), (step) => { pause(); show(step); });
  readout = new Readout($("readout"));
  setSpeed(0);
  outbox = new Outbox(`${store()}/outbox`, (waiting, why) => {
    $("saved").className = why ? "waiting" : "";
    $("saved").textContent = !waiting ? "✓ saved" : why ? `${waiting} not saved: ${why}; trying again` : "saving…";
    document.body.dataset.waiting = waiting;
  }, (vote, why) => {
    session.queue[place(vote.candidate)].vote = null;
    drafts.keep(vote.candidate, draftOf(vote));
    progress();
    open(vote.candidate).then(() => say(`the vote was refused: ${why}`));
  });
  // Votes of an earlier visit that did not reach the server.
  for (const vote of outbox.waiting()) {
    const item = session.queue[place(vote.candidate)];
    if (item) { item.vote = vote; session.latest = vote.uid; }
  }
  outbox.flush();
  progress();
  document.addEventListener("keydown", pressed);
  document.addEventListener("visibilitychange", () => (document.hidden ? keep() : (since = performance.now())));
  addEventListener("pagehide", keep);
  document.addEventListener("click", (event) => {
    const button = event.target.closest("[data-key]");
    if (!button || !episode) return;
    button.blur();
    KEYS[button.dataset.key](event);
  });
  $("comment").addEventListener("input", () => { draft.comment = $("comment").value; keep(); });
  const wanted = decodeURIComponent(location.hash.slice(1));
  const first = session.queue.find((item) => !item.vote);
  await open(place(wanted) >= 0 ? wanted : (first || session.queue[0]).id);
}

start().catch((error) => {
  $("instruction").textContent = "The page cannot start";
  say(error.message);
});
