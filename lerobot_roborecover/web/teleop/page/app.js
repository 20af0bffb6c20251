// The page: what is told on the left, what is asked for on the right. It keeps nothing that matters: a recording
// lives with the simulator, and a reload finds it as it was.

import { Inputs, isMotion } from "./inputs.js";
import { Link } from "./link.js";
import { at, advise, drawnScene, drew, showVeil, tellStatus } from "./status.js";

const SPEEDS = [0.1, 0.2, 0.35, 0.5, 0.75, 1];
const TYPES = ["Wrong Target", "Wrong Pose", "Stage Rollback", "Scene Change"];
const STAGES = ["Approach", "Contact", "Move", "Place"];
const BUSY_MS = 300;

let status = { under_way: false, phase: "connecting" };
let type = "", stage = "";
let confirming = "";
let pictures = 0, steps = 0, lastStep = 0, asked = 0;

const link = new Link({ status: told, pictures: draw, state: connection });
const inputs = new Inputs(
  (device, axes, wait) => {
    const moving = wait || axes.some((v) => v !== 0);
    if (confirming && moving) say("");
    if (moving && drives() && status.phase === "preview") say("press Enter to begin; then the keys move the robot");
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
  asked += 1;
  const slow = setTimeout(() => say("working…", true), BUSY_MS);
  try {
    const answer = await link.ask(kind, values);
    clearTimeout(slow);
    say("");
    return answer;
  } catch (error) {
    clearTimeout(slow);
    say(error.message);
    return null;
  } finally {
    asked -= 1;
  }
}

// Asks for a second press where something would be lost; it counts while the question stands there.
function confirmed(what, text) {
  if (confirming === what) return true;
  say(text);
  confirming = what;
  return false;
}

const listed = () => status.number !== null && status.number !== undefined;
const driven = () => status.under_way && status.step > status.first_step;

async function begin() {
  if (!listed()) return say(status.starts ? "every start is done; B shows the last one again" : "this session lists no starts: give the command --task");
  await ask("start", { number: status.number });
}

async function finish() {
  if (!status.under_way) return begin();
  const lacks = status.lacks;
  if (lacks && !confirmed("save", `${lacks}. Enter again keeps it as dropped, with this reason`)) return;
  const answer = await ask("finish", { as_dropped: Boolean(lacks) });
  if (!answer) return;
  document.body.dataset.saved = answer.saved;
  say(`${answer.saved} is saved${answer.dropped ? ` as dropped: ${answer.dropped}` : ""}`, true);
}

async function discard(key, then) {
  if (driven() && !confirmed(key, `the ${status.step - status.first_step} steps driven here will be lost: ${key} again discards them`)) return;
  if (status.under_way && !then) return ask("discard");
  if (!then) return say("there is nothing to discard");
  const number = Math.min(Math.max(then(listed() ? status.number : status.starts), 0), status.starts - 1);
  if (!status.under_way && number === status.number) return say(`that was the ${number ? "last" : "first"} start`);
  await ask("preview", { number, discard: true });
}

const ACTIONS = {
  KeyM: async () => {
    const answer = await ask("mark", { stage, deviation: type });
    if (!answer) return;
    // Labels that were chosen before the answer came belong to this mark, too.
    const [step, kept, wrong] = answer.status.mark;
    if (kept !== stage || wrong !== type) await ask("relabel", { stage, deviation: type });
    say(`recovery point marked at step ${step}`, true);
  },
  KeyZ: (shift) => ask("back", { steps: shift ? 50 : 10 }),
  Enter: finish,
  Backspace: () => discard("Backspace", null),
  KeyN: () => discard("N", (number) => number + 1),
  KeyB: () => discard("B", (number) => number - 1),
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
const NEEDS_NOTHING = ["KeyV", "Minus", "Equal"];

function press(code, shift) {
  const takeover = status.mode === "takeover";
  if (takeover && !IN_TAKEOVERS.includes(code)) return;
  if (!NEEDS_NOTHING.includes(code) && !code.startsWith("Digit")) {
    if (takeover && !status.under_way) return say("no policy has handed over yet");
    if (!drives() && status.role) return say(`${status.driven ? "another page drives" : "no page drives"}, and this page watches; V takes control`);
    if (status.phase === "loading") return say("still loading; one moment");
    if (asked && code === "Enter") return;  // the press before is not answered yet
  }
  ACTIONS[code]?.(shift);
}

function label(which, name) {
  if (which === "types") type = type === name ? "" : name;
  else stage = stage === name ? "" : name;
  showLabels();
  if (status.mark && drives()) ask("relabel", { stage, deviation: type });
}

function setSpeed(index) {
  const chosen = Math.max(0, Math.min(SPEEDS.length - 1, index));
  inputs.speed = SPEEDS[chosen];
  sessionStorage.setItem("speed", chosen);
  at("speed").textContent = `${Math.round(inputs.speed * 100)} %`;
}

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  // A button that has the focus (Tab) is pressed with Enter and Space, as usual.
  const onButton = event.target instanceof HTMLButtonElement && ["Enter", "Space"].includes(event.code);
  if (onButton && !event.repeat) return;
  if (!isMotion(event.code) && !(event.code in ACTIONS)) return;
  event.preventDefault();
  if (onButton) return;
  if (isMotion(event.code)) {
    document.activeElement?.blur();  // back to driving: Space is the gripper's again
    inputs.key(event.code, true);
  // Taking back may be held down; nothing else repeats.
  } else if (!event.repeat || event.code === "KeyZ") press(event.code, event.shiftKey);
});
addEventListener("keyup", (event) => inputs.key(event.code, false));

// A click with the mouse gives the keys back to the robot; one with the keyboard stays where it is.
function onClick(button, act) {
  button.addEventListener("click", (event) => {
    act();
    if (event.detail > 0) button.blur();
  });
}

for (const button of document.querySelectorAll("button[data-code]")) {
  onClick(button, () => press(button.dataset.code, false));
}
for (const button of document.querySelectorAll("button[data-hold]")) {
  const hold = (down) => {
    button.classList.toggle("held", down);
    inputs.key(button.dataset.hold, down);
  };
  button.addEventListener("pointerdown", (event) => { button.setPointerCapture(event.pointerId); hold(true); });
  for (const end of ["pointerup", "pointercancel"]) button.addEventListener(end, () => { hold(false); button.blur(); });
}

for (const [which, names, first] of [["types", TYPES, 1], ["stages", STAGES, 5]]) {
  names.forEach((name, i) => {
    const button = document.createElement("button");
    const key = document.createElement("kbd");
    key.textContent = first + i;
    button.append(key, ` ${name}`);
    button.dataset.name = name;
    onClick(button, () => label(which, name));
    at(which).append(button);
  });
}

function showLabels() {
  for (const button of document.querySelectorAll("#types button, #stages button")) {
    button.setAttribute("aria-pressed", [type, stage].includes(button.dataset.name));
  }
}

function connection(up, why) {
  if (!up) inputs.release();
  at("link").textContent = up ? "connected" : "no connection";
  at("link").classList.toggle("bad", !up);
  document.body.dataset.link = up ? "up" : "down";
  if (!up) {
    status = { ...status, phase: "connecting" };
    document.body.dataset.phase = "connecting";
    at("advice").textContent = "";
    showVeil("No connection to the simulator", why || "Trying again… What was called saved is on its disk.");
  }
}

function told(message) {
  const ended = status.under_way && !message.under_way;
  const found = message.mark && !status.under_way;  // after a reload
  if (ended || found) { type = message.mark?.[2] ?? ""; stage = message.mark?.[1] ?? ""; showLabels(); }
  if (message.step > lastStep && status.under_way && message.under_way) steps += message.step - lastStep;
  lastStep = message.step ?? 0;
  status = message;
  tellStatus(message);
  if (message.problem) say(message.problem);
}

async function draw(step, parts, scene) {
  for (const { name, jpeg } of parts) {
    const bitmap = await createImageBitmap(jpeg);
    let canvas = document.querySelector(`#cameras canvas[data-camera="${CSS.escape(name)}"]`);
    if (!canvas) {
      const figure = document.createElement("figure");
      const caption = document.createElement("figcaption");
      canvas = document.createElement("canvas");
      caption.textContent = status.captions?.[name] ?? "";
      canvas.dataset.camera = name;
      figure.append(canvas, caption);
      at("cameras").append(figure);
    }
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    canvas.dataset.step = step;
    bitmap.close();
  }
  pictures += 1;
  if (drawnScene() !== scene) {
    drew(scene);
    advise(status);
  }
}

setInterval(() => {
  const pace = `${pictures} pictures/s, ${steps} steps/s (${Math.round((100 * steps) / status.control_hz)} % of real time)`;
  at("rates").textContent = !status.under_way || !status.control_hz ? "" : steps ? pace : "time stands still while nothing is held";
  at("pad").textContent = inputs.pad() ? "gamepad connected" : "";
  pictures = steps = 0;
  advise(status);
}, 1000);
