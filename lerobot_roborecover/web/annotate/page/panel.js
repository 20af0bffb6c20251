// What stands beside the frames: the episode in words, suggestions once there is a vote, and in a discussion the
// votes so far.

import { element } from "./guide.js";

const $ = (id) => document.getElementById(id);

function inWords(vote, reasons) {
  if (vote.verdict !== "discard") return `frame ${vote.step}, ${vote.stage}, ${vote.deviation}`;
  const known = reasons.find((reason) => reason.name === vote.reason);
  return `discard (${(known ? known.text : vote.reason).split(":")[0].toLowerCase()})`;
}

export function fillAbout(episode, number, reasons) {
  $("instruction").textContent = episode.instruction;
  const parts = [
    `episode ${number}`, `${episode.steps} frames`, `ends ${episode.solved_at_end ? "solved" : "unsolved"}`,
    ...(episode.vote ? [`your vote: ${inWords(episode.vote, reasons)}`] : []), episode.task,
  ];
  $("about").textContent = $("about").title = parts.join(" · ");
}

export function fillSuggestions(episode, show) {
  const found = episode.suggestions;
  $("suggest").hidden = !episode.vote || found !== null;
  $("suggestions").hidden = !found;
  $("suggestions").replaceChildren(...(found || []).map((s) => {
    const item = element("li");
    const button = element("button", `frame ${s.step}`);
    button.addEventListener("click", () => show(s.step));
    item.append(button, ` suggested by ${s.by}: ${s.text}`);
    return item;
  }));
  if (found && !found.length) $("suggestions").append(element("li", "no suggestions for this episode"));
}

export function fillDiscussion(said, reasons) {
  $("discussion").hidden = !said;
  if (!said) return;
  const votes = element("ul");
  votes.append(...said.votes.map((v) => element("li", [inWords(v, reasons), v.comment].filter(Boolean).join(": "))));
  $("discussion").replaceChildren(element("b", `To discuss: ${said.why}`), votes);
}
