// Keys and buttons: every button says which key it stands for. A button that was reached with Tab takes Enter and
// Space itself; one that was clicked gives the keyboard back, so that Space plays and Enter saves.

const $ = (id) => document.getElementById(id);

// keys: what each does, by `KeyboardEvent.key`. ready(): whether there is an episode. reason(number): of the list.
export function listen(keys, ready, reason) {
  const pressed = (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.target === $("comment")) {
      if (key === "Escape") { event.preventDefault(); $("comment").blur(); }
      return;
    }
    if ((key === "Enter" || key === " ") && event.target.closest?.("button, a")) {
      if (event.repeat) event.preventDefault();
      return;
    }
    const open = document.querySelector("dialog[open]");
    if (open) {
      if (open.id === "guide" && key === "g") open.close();
      if (open.id === "reasons" && /^[1-9]$/.test(key)) reason(Number(key));
      if (/^[0-9a-z ]$/.test(key)) event.preventDefault();
      return;
    }
    if (!ready() || !keys[key] || (event.repeat && !key.startsWith("Arrow"))) return;
    event.preventDefault();
    keys[key](event);
  };
  document.addEventListener("keydown", pressed);
  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    // A click without a pointer comes from the keyboard, which stays where it is.
    if (button && event.detail) button.blur();
    if (button?.dataset.key && ready()) keys[button.dataset.key](event);
  });
}
