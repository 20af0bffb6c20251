// The page: what is told on the left, what is asked for on the right. It keeps nothing that matters: a recording
// lives with the simulator, and a reload finds it as it was.

import { Inputs, isMotion } from "./inputs.js";
import { Link } from "./link.js";

const SPEEDS = [0.1, 0.2, 0.35, 0.5, 0.75, 1];
const TYPES = ["Wrong Target", "Wrong Pose", "Stage Rollback", "Scene Change"];
const STAGES = ["Approach", "Contact", "Move", "Place"];
const at = (id) => document.getElementById(id);

let status = { under_way: false };
let type = "", stage = "";
let confirming = "";
let pictures = 0, steps = 0, lastStep = 0;

const link = new Link({ status: told, pictures: draw, state: connection });
const inputs = new Inputs(
  (device, axes, wait) => {
    if (confirming && (wait || axes.some((v) => v !== 0))) say("");
    if (drives()) link.tell("hold", { device, axes, wait });
  },
  (code) => press(code, false),
);
const speedAt = Number(sessionStorage.getItem("speed") ?? 3);
setSpeed(SPEEDS[speedAt] ? speedAt : 3);

function drives() {
  return status.role === "drive";
}

function say(text, good = false) {
  confirming = "";
  at("message").textContent = text;
  at("message").classList.toggle("good", good);
}

async function ask(kind, values) {
  try {
    const answer = await link.ask(kind, values);
    say("");
    return answer;
  } catch (error) {
    say(error.message);
    return null;
  }
}

// Asks for a second press where something would be lost; it counts while the question stands there.
function confirmed(what, text) {
  if (confirming === what) return true;
  say(text);
  confirming = what;
  return false;
}

async function start(number) {
  if (number < 0 || number >= status.starts) return say("that was the last start; Ctrl-C in the terminal ends the session");
  await ask("start", { number });
}

const next = () => (status.number === null || status.number === undefined ? 0 : status.number + 1);
const driven = () => status.under_way && status.step > status.first_step;

async function finish() {
  if (!status.under_way) return start(next());
  const lacks = status.lacks;
  if (lacks && !confirmed("save", `${lacks}. Enter again keeps it as dropped, with this reason`)) return;
  const answer = await ask("finish", { as_dropped: Boolean(lacks) });
  if (!answer) return;
  const saved = `${answer.saved} is saved${answer.dropped ? ` as dropped: ${answer.dropped}` : ""}`;
  document.body.dataset.saved = answer.saved;
  if (next() < status.starts) await start(next());
  say(saved, true);
}

async function discard(then) {
  if (driven() && !confirmed("discard", "the recording will be lost: press again to discard it")) return;
  const number = status.number;
  if (status.under_way && !(await ask("discard"))) return;
  if (then) await start(then(number));
}

const ACTIONS = {
  KeyM: async () => {
    const answer = await ask("mark", { stage, deviation: type });
    if (answer) say(`recovery point at step ${answer.status.mark[0]}; now complete the task`, true);
  },
  KeyZ: (shift) => ask("back", { steps: shift ? 50 : 10 }),
  Enter: finish,
  Backspace: () => discard(null),
  KeyN: () => discard((number) => (number ?? -1) + 1),
  KeyB: () => discard((number) => Math.max((number ?? 0) - 1, 0)),
  KeyH: () => ask("hand_back"),
  KeyV: () => ask("drive"),
  KeyX: () => ask("realtime", { on: !status.realtime }),
  Space: () => ask("gripper"),
  Minus: () => setSpeed(SPEEDS.indexOf(inputs.speed) - 1),
  Equal: () => setSpeed(SPEEDS.indexOf(inputs.speed) + 1),
};
TYPES.forEach((name, i) => { ACTIONS[`Digit${i + 1}`] = () => label("types", name); });
STAGES.forEach((name, i) => { ACTIONS[`Digit${i + 5}`] = () => label("stages", name); });

const IN_TAKEOVERS = ["Space", "KeyH", "KeyV", "KeyX", "Minus", "Equal"];

function press(code, shift) {
  if (status.mode === "takeover" && !IN_TAKEOVERS.includes(code)) return;
  if (status.mode === "takeover" && !status.under_way && code !== "KeyV") return say("no policy has handed over yet");
  ACTIONS[code]?.(shift);
}

function label(which, name) {
  if (which === "types") type = type === name ? "" : name;
  else stage = stage === name ? "" : name;
  showLabels();
  if (status.mark) ask("relabel", { stage, deviation: type });
}

function setSpeed(index) {
  const chosen = Math.max(0, Math.min(SPEEDS.length - 1, index));
  inputs.speed = SPEEDS[chosen];
  sessionStorage.setItem("speed", chosen);
  at("speed").textContent = `${Math.round(inputs.speed * 100)} %`;
}

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (!isMotion(event.code) && !(event.code in ACTIONS)) return;
  event.preventDefault();
  if (isMotion(event.code)) inputs.key(event.code, true);
  // Taking back may be held down; nothing else repeats.
  else if (!event.repeat || event.code === "KeyZ") press(event.code, event.shiftKey);
});
addEventListener("keyup", (event) => inputs.key(event.code, false));
for (const button of document.querySelectorAll("button[data-code]")) {
  button.addEventListener("click", () => { press(button.dataset.code, false); button.blur(); });
}

for (const [which, names, first] of [["types", TYPES, 1], ["stages", STAGES, 5]]) {
  names.forEach((name, i) => {
    const button = document.createElement("button");
    const key = document.createElement("kbd");
    key.textContent = first + i;
    button.append(key, ` ${name}`);
    button.dataset.name = name;
    button.addEventListener("click", () => { label(which, name); button.blur(); });
    at(which).append(button);
  });
}

function showLabels() {
  for (const button of document.querySelectorAll("#types button, #stages button")) {
    button.setAttribute("aria-pressed", [type, stage].includes(button.dataset.name));
  }
}

function connection(up) {
  if (!up) inputs.release();
  at("link").textContent = up ? "connected" : "no connection; trying again";
  at("link").classList.toggle("bad", !up);
  document.body.dataset.link = up ? "up" : "down";
}

function told(message) {
  const began = message.under_way && (!status.under_way || message.label !== status.label);
  status = message;
  if (began) { type = message.mark?.[2] ?? ""; stage = message.mark?.[1] ?? ""; showLabels(); }
  if (message.step > lastStep) steps += message.step - lastStep;
  lastStep = message.step ?? 0;
  const body = document.body.dataset;
  Object.assign(body, { mode: message.mode ?? "", role: message.role, step: message.step ?? "", saved_count: message.saved ?? "" });
  body.under = message.under_way ? "way" : "";
  body.mark = message.mark ? message.mark[0] : "";
  body.solved = message.solved ? "yes" : "no";
  body.turns = message.axes?.includes("yaw") ? "yes" : "no";
  at("instruction").textContent = message.instruction ?? (message.mode === "takeover"
    ? "Waiting for a policy to hand over"
    : message.starts ? "Enter starts" : "No starts listed: a script may start a task");
  const place = message.number === null || message.number === undefined ? "" : ` (${message.number + 1} of ${message.starts})`;
  at("about").textContent = message.under_way ? `${message.label ?? ""}${place}` : "";
  at("step").textContent = message.step ?? "–";
  const since = message.mark ? message.step - message.mark[0] : null;
  at("since").textContent = since === null ? "" : `${since} of ${message.horizon} since the mark`;
  at("since").classList.toggle("bad", since !== null && since > message.horizon);
  at("solved").textContent = !message.under_way ? "" : message.solved ? "✔ solved" : "not solved";
  at("marked").textContent = message.mark
    ? `marked at step ${[message.mark[0], message.mark[1], message.mark[2]].filter((v) => v !== "").join(" · ")}`
    : message.under_way && message.mode === "record" ? "no recovery point marked" : "";
  at("save-text").textContent = !message.under_way ? "Start" : message.lacks ? "Save (as dropped)" : "Save, next start";
  at("save").classList.toggle("ready", Boolean(message.under_way && !message.lacks));
  at("gripper").textContent = message.gripper === false ? "no gripper" : message.closed ? "Gripper: closed" : "Gripper: open";
  at("realtime").textContent = `Real time: ${message.realtime ? "on" : "off"}`;
  at("wheel").hidden = drives();
  at("saved").textContent = message.mode === "record"
    ? `${message.saved} saved by now. A recording is kept once it is called saved; a stopped server loses the one under way.` : "";
  at("note").textContent = message.role === "watch" ? "This page watches; somebody else drives." : "";
  if (message.problem) say(message.problem);
}

async function draw(step, parts) {
  for (const { name, jpeg } of parts) {
    const bitmap = await createImageBitmap(jpeg);
    let canvas = document.querySelector(`#cameras canvas[data-camera="${CSS.escape(name)}"]`);
    if (!canvas) {
      canvas = document.createElement("canvas");
      canvas.dataset.camera = name;
      at("cameras").append(canvas);
    }
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    canvas.dataset.step = step;
    bitmap.close();
  }
  pictures += 1;
}

setInterval(() => {
  at("rates").textContent = `${pictures} pictures/s, ${steps} steps/s`;
  at("pad").textContent = inputs.pad() ? "gamepad connected" : "";
  pictures = steps = 0;
}, 1000);
