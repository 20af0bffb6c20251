"use strict";
// Opens one trial of a card. A card holds its trials packed (trial_details.py); they are unpacked when one is asked for,
// and the signs of a card become buttons when it comes into the document.
(function () {
  const SIGNS = { "●": "solved", "○": "not solved", "!": "invalid" };
  const SVG = "http://www.w3.org/2000/svg";
  const dialog = document.getElementById("trial");
  const list = document.getElementById("cards");
  const part = (name) => document.getElementById("trial-" + name);
  const unpacked = new WeakMap();
  let open = null;

  const upgrade = (card) => {
    if (!(card instanceof HTMLElement) || !card.dataset.trials || card.dataset.opens) return;
    card.dataset.opens = "yes";
    for (const signs of card.querySelectorAll(".signs")) {
      const policy = signs.parentElement.dataset.policy;
      const from = signs.dataset.start === "initial" ? "initial state, " : "";
      signs.replaceChildren(...Array.from(signs.textContent, (sign, index) => {
        if (!(sign in SIGNS)) return sign;
        const button = document.createElement("button");
        button.type = "button";
        button.textContent = sign;
        button.dataset.index = index;
        button.setAttribute("aria-label", policy + ", " + from + "trial " + (index + 1) + ": " + SIGNS[sign]);
        return button;
      }));
      signs.removeAttribute("aria-hidden");
    }
  };

  const unpack = async (card) => {
    if (!unpacked.has(card)) {
      const bytes = Uint8Array.from(atob(card.dataset.trials), (letter) => letter.charCodeAt(0));
      const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
      unpacked.set(card, JSON.parse(await new Response(stream).text()));
    }
    return unpacked.get(card);
  };

  const drawn = (kind, values, text) => {
    const made = document.createElementNS(SVG, kind);
    for (const [name, value] of Object.entries(values)) made.setAttribute(name, value);
    if (text) made.textContent = text;
    return made;
  };
  const LEFT = 92;
  const width = () => Math.max(280, Math.min(460, innerWidth - 56)); // about one unit a pixel
  // One line of a chart: its name and range at the left, values from 0 to `top` over the trial's steps.
  const line = (svg, wide, y, tall, name, range, values, top) => {
    const x = (k) => LEFT + (wide - LEFT - 4) * (values.length > 1 ? k / (values.length - 1) : 0);
    svg.append(
      drawn("rect", { x: LEFT, y, width: wide - LEFT - 4, height: tall, class: "field" }),
      drawn("text", { x: 0, y: y + 12, class: "name" }, name),
      drawn("text", { x: 0, y: y + 25, class: "range" }, range),
      drawn("polyline", { points: values.map((v, k) => x(k).toFixed(1) + "," + (y + tall - 2 - (tall - 4) * v / top).toFixed(1)).join(" ") }),
    );
  };
  const stepsOf = (row) => (Array.isArray(row.interventions) ? row.interventions : [])
    .map((one) => (Array.isArray(one) ? one[1] : one.step)).filter((step) => Number.isFinite(step));
  const chart = (trial, row) => {
    const lines = [];
    const wide = width();
    const rounded = (value) => Number(value.toPrecision(2));
    // Where a task tells success alone, a curve would say that nothing moved.
    if (trial.progress && trial.progress.some((done) => done > 0 && done < 100)) lines.push(["progress", "0 to 100 %", trial.progress, 100, 60]);
    if (trial.actions) {
      trial.actions.levels.forEach((values, k) => lines.push(
        [trial.actions.names[k], rounded(trial.actions.low[k]) + " to " + rounded(trial.actions.high[k]), values, 99, 34]));
    }
    if (!lines.length) return null;
    const tall = lines.reduce((sum, one) => sum + one[4] + 6, 0);
    const svg = drawn("svg", { viewBox: "0 0 " + wide + " " + (tall + 20), role: "img",
      "aria-label": "Over " + row.steps + " steps: " + lines.map((one) => one[0]).join(", ") });
    let y = 0;
    for (const [name, range, values, top, height] of lines) {
      line(svg, wide, y, height, name, range, values, top);
      y += height + 6;
    }
    for (const step of stepsOf(row)) {
      const x = LEFT + (wide - LEFT - 4) * Math.min(1, step / Math.max(1, row.steps));
      svg.append(drawn("line", { x1: x, x2: x, y1: 0, y2: tall, class: "mark" }));
    }
    svg.append(drawn("text", { x: LEFT, y: tall + 14, class: "range" }, "handoff"),
      drawn("text", { x: wide - 4, y: tall + 14, class: "range", "text-anchor": "end" }, "step " + row.steps));
    return svg;
  };

  const mm = (value) => (typeof value === "number" ? value.toFixed(value && value < 0.01 ? 4 : 2) + " mm" : "not measured");
  const words = (value) => String(value).replaceAll("_", " ");
  const intervention = (one) => {
    if (Array.isArray(one)) return one[0] + " at step " + one[1];
    const { kind, step, ...rest } = one;
    const more = Object.entries(rest).map(([name, value]) => words(name) + " " + value).join(", ");
    return kind + " at step " + step + (more ? " (" + more + ")" : "");
  };
  const startError = (error) => {
    if (!error) return "not measured";
    const joints = Math.max(...Object.values(error.joints).map(Math.abs), 0);
    const cameras = Object.entries(error.cameras).map(([name, one]) => name + ": "
      + [["camera", one.background_px], ["objects", one.object_px]].filter(([, value]) => value !== null)
        .map(([what, value]) => what + " " + value.toFixed(1) + " px").join(", ") + (one.moving ? " (on the arm)" : ""));
    return ["worst joint " + joints.toFixed(2), ...cameras].join("; ");
  };
  const facts = (trial, row) => {
    const found = [["Outcome", trial.ending + " after " + row.steps + " of " + row.horizon + " steps"]];
    if (row.reason) found.push(["Reason", row.reason]);
    if (row.robot) {
      found.push(["Start error", startError(row.robot.start_error)]);
      found.push(["Verdict", row.robot.verdict + (row.robot.note ? ": " + row.robot.note : "")]);
      if (row.robot.episode !== null) found.push(["Recording", "episode " + row.robot.episode + " of the run's dataset"]);
    } else found.push(["Handoff", row.handoff_eef_error_mm === null && row.handoff_object_error_mm === null
      ? (row.start === "recovery" ? "not in this log" : "none: the task's own start")
      : "step " + row.handoff_step + "; end effector " + mm(row.handoff_eef_error_mm) + ", objects " + mm(row.handoff_object_error_mm)
        + " off" + (row.handoff_identical ? "; the state is identical" : "")]);
    found.push(["Interventions", row.interventions.length ? row.interventions.map(intervention).join("; ") : "none"]);
    if (!trial.actions && !row.robot) found.push(["Actions", "not recorded (--env.record_actions=true records them)"]);
    return found.flatMap(([name, text]) => {
      const term = document.createElement("dt");
      const fact = document.createElement("dd");
      term.textContent = name;
      fact.textContent = text;
      return [term, fact];
    });
  };

  const seen = (card, trial, row) => {
    const clip = trial.start === "recovery" && Array.from(card.querySelectorAll(".clips > div"))
      .find((one) => one.dataset.policy === trial.policy && Number(one.dataset.trial) === row.trial);
    const video = clip && clip.querySelector("video");
    if (video) {
      const copy = video.cloneNode();
      copy.preload = "auto";
      copy.hidden = false;
      return copy;
    }
    const frame = trial.start === "recovery" && card.querySelector("img");
    return frame ? frame.cloneNode() : null;
  };

  const show = (card, data, number) => {
    const trial = data.trials[number];
    const row = { ...data.shared, ...trial.row };
    open = { card, data, number };
    const from = trial.start === "initial" ? "the initial state" : "the recovery point";
    part("title").textContent = trial.policy + ", trial " + (trial.index + 1) + ": " + (row.success ? "solved" : trial.ending);
    part("about").textContent = row.instruction + ". " + row.scenario_id + ", from " + from + ".";
    const view = seen(card, trial, row);
    part("seen").replaceChildren(...(view ? [view] : []));
    const curves = chart(trial, row);
    part("curves").replaceChildren(...(curves ? [curves] : []));
    part("facts").replaceChildren(...facts(trial, row));
    part("row").textContent = JSON.stringify(row, null, 1);
    part("before").disabled = number === 0;
    part("after").disabled = number === data.trials.length - 1;
    if (!dialog.open) dialog.showModal();
    dialog.scrollTop = 0;
    part("title").focus();
  };

  list.addEventListener("click", async (event) => {
    const button = event.target instanceof Element ? event.target.closest(".signs > button") : null;
    if (!button) return;
    const card = button.closest("li");
    const data = await unpack(card);
    const signs = button.parentElement;
    show(card, data, data.trials.findIndex((trial) => trial.policy === signs.parentElement.dataset.policy
      && trial.start === signs.dataset.start && trial.index === Number(button.dataset.index)));
  });
  part("before").addEventListener("click", () => show(open.card, open.data, open.number - 1));
  part("after").addEventListener("click", () => show(open.card, open.data, open.number + 1));
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  dialog.addEventListener("close", () => part("seen").replaceChildren());
  new MutationObserver((changes) => changes.forEach((change) => change.addedNodes.forEach(upgrade)))
    .observe(list, { childList: true });
  Array.from(list.children).forEach(upgrade);
})();
