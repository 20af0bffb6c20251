// What the page says about how things stand: where the recording is, and what to do next.

export const at = (id) => document.getElementById(id);

const LOADS = "The first start of a task takes 3 to 13 seconds, on a busy machine longer.";
let loadingSince = 0, loadingWhat = "";
let scene;

// Which start's picture is on the screen.
export const drawnScene = () => scene;
export const drew = (number) => { scene = number; };

export function showVeil(title, text, still = false) {
  at("veil").hidden = false;
  at("veil-title").textContent = title;
  at("veil-text").textContent = text;
  document.body.dataset.veil = still ? "still" : "turns";
}

export function tellStatus(message) {
  const { phase, mark, horizon, under_way: driving } = message;
  const since = mark ? message.step - mark[0] : null;
  Object.assign(document.body.dataset, {
    mode: message.mode ?? "", phase: phase ?? (driving ? "driving" : "idle"), role: message.role,
    step: message.step ?? "", saved_count: message.saved ?? "", under: driving ? "way" : "",
    mark: mark ? mark[0] : "", solved: message.solved ? "yes" : "no", proven: message.proven ? "yes" : "no",
    late: since > horizon && !message.proven ? "yes" : "no", turns: message.axes?.includes("yaw") ? "yes" : "no",
  });
  at("instruction").textContent = message.instruction ?? (message.mode === "takeover"
    ? "Waiting for a policy to hand over" : message.starts ? "Every start is done" : "No starts listed");
  const place = message.number === null || message.number === undefined ? "" : ` (${message.number + 1} of ${message.starts})`;
  at("about").textContent = message.label ? `${message.label}${place}` : "";
  at("step").textContent = driving ? message.step : "–";
  at("solved").textContent = !driving ? "" : message.solved ? "✔ solved" : "not solved";
  at("marked").textContent = !driving || message.mode !== "record" ? ""
    : mark ? `marked at step ${mark.filter((v) => v !== "").join(" · ")}` : "no recovery point marked";
  at("since").textContent = since === null ? "" : `${since} of ${horizon} steps`;
  at("left").hidden = since === null;
  at("left-bar").style.width = since === null ? "0" : `${Math.min(100, (100 * since) / horizon)}%`;
  at("within").textContent = horizon ? ` within ${horizon} steps` : "";
  at("save-text").textContent = !driving ? "Begin" : message.lacks ? "Save (as dropped)" : "Save";
  at("save").classList.toggle("ready", Boolean(driving ? !message.lacks : phase === "preview"));
  at("save").disabled = message.role !== "drive" || phase === "loading" || (phase === "idle" && message.number === null);
  at("gripper").textContent = message.gripper === false ? "no gripper" : message.closed ? "Gripper: closed" : "Gripper: open";
  at("realtime").textContent = `Real time: ${message.realtime ? "on" : "off"}`;
  at("wheel").hidden = message.role === "drive";
  at("saved").textContent = message.mode === "record"
    ? `${message.saved} saved, on disk${driving ? "; this one not yet" : ""}` : "";
  for (const button of document.querySelectorAll("button.driving")) button.disabled = !driving || message.role !== "drive";
  at("grip").disabled ||= message.gripper === false;
  for (const button of document.querySelectorAll("button.listed")) button.disabled = !message.starts || message.role !== "drive";
  showPart(message);
  advise(message);
}

function showPart({ under_way: driving, mark, proven, step, first_step: first }) {
  const order = ["drive", "mark", "solve"];
  const now = !driving ? -1 : proven ? 3 : mark ? 2 : step > first ? 1 : 0;
  for (const line of document.querySelectorAll("#howto li")) {
    const place = order.indexOf(line.dataset.part);
    line.classList.toggle("now", place === now);
    line.classList.toggle("done", place < now);
  }
}

// Said again every second while something loads, with the time that has passed.
export function advise(message) {
  if (document.body.dataset.link !== "up") return;
  if (message.phase === "loading") {
    if (loadingWhat !== message.label) [loadingSince, loadingWhat] = [performance.now(), message.label];
    const passed = Math.round((performance.now() - loadingSince) / 1000);
    const [done, of] = message.replayed ?? [0, 0];
    const replay = done ? ` ${done} of ${of} steps replayed.` : "";
    showVeil(`Loading ${message.label}…`, `${passed} s. ${LOADS}${replay}`);
  } else {
    loadingWhat = "";
    const nothing = message.mode === "takeover" ? !message.under_way : message.phase === "idle";
    at("veil").hidden = !nothing;
    if (nothing) showVeil(...nothingUnderWay(message));
    else if (message.scene !== undefined && message.scene !== scene) showVeil(`Loading ${message.label}…`, "It is ready; its first picture is being made.");
  }
  at("advice").textContent = advice(message);
}

function nothingUnderWay(message) {
  if (message.mode === "takeover") return ["Waiting for a policy to hand over", "The evaluation goes on by itself until it needs you."];
  if (!message.starts) return ["This session lists no starts", "Give the command --task (and --seeds), or let a script start one.", true];
  if (message.number === null) return ["Every start is done", "Ctrl-C in the terminal ends the session and writes the dataset. B shows the last start again.", true];
  return ["Nothing is loaded", "Enter loads the start and begins.", true];
}

function advice(message) {
  const { phase, mark, horizon } = message;
  if (message.role === "watch") {
    return message.driven ? "This page watches; another page drives." : "This page watches; no page drives.";
  }
  if (message.mode === "takeover") return message.under_way ? "Drive, and hand back with H." : "";
  if (phase === "loading") return "Loading…";
  if (phase === "preview") return `This is the start: Enter begins${message.starts > 1 ? "; N and B show others" : ""}.`;
  if (!message.under_way) return "";
  if (message.proven) return "Solved after the mark: Enter saves it.";
  if (mark) {
    const left = horizon - (message.step - mark[0]);
    return left > 0 ? `Now solve the task after all: ${left} of ${horizon} steps are left.`
      : `The ${horizon} steps after the mark are over. Z takes steps back, Backspace discards.`;
  }
  if (message.solved) return "The task is solved, and nothing was marked. Z takes steps back, Backspace discards.";
  if (message.step === message.first_step) return "Hold W A S D E Q to move, and make something go wrong: push the object away, or miss it.";
  return "Once something has gone wrong, press M.";
}
