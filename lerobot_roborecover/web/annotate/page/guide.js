// The guide's page: definitions, and an example frame of each cell. Everything is set as text, never as HTML.

export function element(tag, text = "", attributes = {}) {
  const made = document.createElement(tag);
  made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

function definitions(items) {
  const list = element("dl");
  for (const item of items) {
    const term = element("dt");
    term.append(element("kbd", item.key.toUpperCase()), ` ${item.name}`);
    list.append(term, element("dd", item.text));
  }
  return list;
}

// there: {pictures: cells that have one, coming: whether more may come}.
function example(cell, there) {
  const figure = element("figure");
  const none = there.coming ? "the example frame is being rendered; open the guide again" : "no example frame";
  const picture = there.pictures.includes(cell.slug)
    ? element("img", "", { alt: `Example: ${cell.stage}, ${cell.type}`, src: `api/examples/${cell.slug}` })
    : element("div", none, { class: "none" });
  const caption = element("figcaption");
  caption.append(element("b", `${cell.stage} – ${cell.type}`), cell.text);
  figure.append(picture, caption);
  return figure;
}

export function fillGuide(place, guide) {
  const cells = element("div", "", { class: "cells" });
  fetch("api/examples").then((answer) => answer.json()).catch(() => null).then((said) => {
    const there = said?.pictures ? said : { pictures: [], coming: false };
    cells.append(...guide.cells.map((cell) => example(cell, there)));
  });
  const how = element("ol");
  how.append(...[
    "Watch the whole trajectory: Space plays, the arrow keys step, a click into the plots goes there.",
    "Nothing to keep? T where it recovers by itself, D with another reason.",
    "Otherwise go to the recovery point and press R, then a letter for the stage, a digit for the type, and Enter.",
  ].map((text) => element("li", text)));
  place.replaceChildren(
    element("h2", "How to mark an episode"), how,
    element("h2", "Recovery point"), ...guide.recovery_point.map((text) => element("p", text)),
    element("h2", "Stage: what has to be resumed"), definitions(guide.stages),
    element("h2", "Type: what prevents normal interaction"), definitions(guide.types),
    element("h2", "The nine cells of the paper's test sets (others may be marked)"), cells,
  );
}
