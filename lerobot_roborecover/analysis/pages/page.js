"use strict";
// Says of a table that it goes on sideways, where it does, and shades the edge of its first column once moved.
(function () {
  const areas = Array.from(document.querySelectorAll(".scroll"));
  const look = () => {
    for (const area of areas) {
      const hint = area.previousElementSibling;
      if (hint && hint.classList.contains("hint")) hint.hidden = area.scrollWidth <= area.clientWidth + 1;
    }
  };
  for (const area of areas) {
    area.addEventListener("scroll", () => area.classList.toggle("beyond", area.scrollLeft > 0), { passive: true });
  }
  // A folded table has no width yet; what is printed is unfolded.
  for (const fold of document.querySelectorAll("details")) fold.addEventListener("toggle", look);
  addEventListener("beforeprint", () => {
    for (const fold of document.querySelectorAll("details.tables")) fold.open = true;
  });
  addEventListener("resize", look);
  look();
})();
