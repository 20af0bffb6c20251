"use strict";
// Filters and sorts the cards. What is asked about a card is read once; the document holds a page of those that fit, and
// the next page when its end comes into sight, so that a key costs the same for 60 scenarios as for 2,000.
(function () {
  const PAGE = 60;
  const list = document.getElementById("cards");
  const cards = Array.from(list.children, (element) => ({
    element,
    id: element.dataset.id,
    cell: element.dataset.cell,
    source: element.dataset.source,
    suite: element.dataset.suite,
    outcome: element.dataset.outcome.split(" "),
    disagreement: Number(element.dataset.disagreement),
    rate: Number(element.dataset.rate),
    rates: Object.fromEntries(Array.from(element.querySelectorAll("dt[data-rate]"),
      (mark) => [mark.dataset.policy, Number(mark.dataset.rate)])),
    text: element.textContent.toLowerCase(),
  }));
  const selects = Array.from(document.querySelectorAll("#filters select[data-key]"));
  const text = document.getElementById("filter-text");
  const sort = document.getElementById("sort");
  const count = document.getElementById("count");
  const more = document.getElementById("more");
  const byId = (a, b) => (a.id < b.id ? -1 : a.id > b.id ? 1 : 0);
  const orders = {
    disagreement: (a, b) => b.disagreement - a.disagreement || byId(a, b),
    hard: (a, b) => a.rate - b.rate || byId(a, b),
    easy: (a, b) => b.rate - a.rate || byId(a, b),
    id: byId,
  };
  const [first, second, where] = ["pair-a", "pair-b", "pair-where"].map((id) => document.getElementById(id));
  // Two policies side by side: everybody else's marks and videos are put away.
  const paired = () => (first && first.value && second.value && first.value !== second.value
    ? [first.value, second.value] : null);
  const fitsPair = (card, pair) => {
    if (!pair) return true;
    const [a, b] = pair.map((policy) => card.rates[policy]);
    if (a === undefined || b === undefined) return false;
    return where.value === "differ" ? a !== b : where.value === "a" ? a > b : where.value === "b" ? b > a : true;
  };
  const showPair = () => {
    const pair = paired();
    list.classList.toggle("paired", pair !== null);
    for (const card of cards) {
      for (const part of card.element.querySelectorAll("[data-policy]")) {
        part.hidden = pair !== null && !pair.includes(part.dataset.policy);
        part.style.order = pair ? pair.indexOf(part.dataset.policy) : "";
      }
    }
  };
  let fitting = cards;
  let shown = 0;
  const extend = (cardsMore) => {
    list.append(...fitting.slice(shown, shown + cardsMore).map((card) => card.element));
    shown = Math.min(fitting.length, shown + cardsMore);
    more.hidden = shown === fitting.length;
  };
  const filter = () => {
    const chosen = selects.filter((select) => select.value).map((select) => [select.dataset.key, select.value]);
    const wanted = text.value.trim().toLowerCase();
    const pair = paired();
    const before = fitting.slice(0, shown);
    fitting = cards.filter((card) => chosen.every(([key, value]) => (
      key === "outcome" ? card.outcome.includes(value) : card[key] === value))
      && (!wanted || card.text.includes(wanted)) && fitsPair(card, pair));
    const now = fitting.slice(0, PAGE);
    if (before.length !== now.length || before.some((card, k) => card !== now[k])) {
      list.replaceChildren();
      shown = 0;
      extend(PAGE);
    }
    more.hidden = shown === fitting.length;
    count.textContent = fitting.length + " of " + cards.length + " scenarios";
  };
  const arrange = () => {
    cards.sort(orders[sort.value]);
    filter();
  };
  for (const select of selects) select.addEventListener("change", filter);
  text.addEventListener("input", filter);
  sort.addEventListener("change", arrange);
  for (const select of [first, second, where]) {
    if (select) select.addEventListener("change", () => { showPair(); filter(); });
  }
  const form = document.getElementById("filters");
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => setTimeout(() => { if (first) showPair(); arrange(); }, 0));
  more.addEventListener("click", () => extend(PAGE));
  new IntersectionObserver((found) => { if (found.some((entry) => entry.isIntersecting)) extend(PAGE); }, { rootMargin: "600px" })
    .observe(more);
  addEventListener("beforeprint", () => extend(fitting.length));
  list.replaceChildren();
  fitting = [];
  arrange();
})();
