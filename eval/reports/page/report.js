
// Filters and sorts the episodes, and says where a picture is missing. Without it the page shows everything.
"use strict";
(() => {
  document.addEventListener("error", event => {
    const image = event.target, film = image.closest && image.closest(".film");
    if (!film) return;
    film.classList.add("missing");
    image.replaceWith(image.alt + ": the picture is not in this folder");
  }, true);
})();
document.addEventListener("DOMContentLoaded", () => {
  const body = document.querySelector("#episodes tbody"), box = document.querySelector("#controls");
  if (!body || !box) return;
  const rows = [...body.rows], selects = [...box.querySelectorAll("select")], count = box.querySelector("output");
  const show = () => {
    let shown = 0;
    for (const row of rows) {
      row.hidden = selects.some(s => s.value && row.dataset[s.name] !== s.value);
      shown += !row.hidden;
    }
    count.textContent = shown + " of " + rows.length + " episodes";
  };
  for (const select of selects) select.addEventListener("change", show);
  for (const head of document.querySelectorAll("#episodes th[data-key]")) {
    const button = document.createElement("button");
    button.type = "button"; button.textContent = head.textContent; head.replaceChildren(button);
    button.addEventListener("click", () => {
      const way = head.getAttribute("aria-sort") === "ascending" ? -1 : 1, key = head.dataset.key;
      for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", way > 0 ? "ascending" : "descending");
      const value = row => row.dataset[key] ?? "";
      const numbers = rows.every(row => value(row) === "" || Number.isFinite(Number(value(row))));
      const order = (a, b) => {
        const x = value(a), y = value(b);
        if (x === "" || y === "") return (x === "") - (y === "");
        const by = numbers ? Number(x) - Number(y) : x < y ? -1 : x > y ? 1 : 0;
        return way * by || Number(a.dataset.index) - Number(b.dataset.index);
      };
      body.append(...[...rows].sort(order));
    });
  }
  box.hidden = false; show();
});
