
// Filters the rows of all tables, and sorts a table by any of its columns. Without it the page shows everything.
"use strict";
document.addEventListener("DOMContentLoaded", () => {
  const form = document.querySelector("#filters"), selects = [...form.querySelectorAll("select")];
  const rows = [...document.querySelectorAll(".board tbody tr")], count = form.querySelector("output");
  const show = () => {
    const fits = (row, s) => !s.value || row.dataset[s.name].split("+").includes(s.value);
    let shown = 0;
    for (const row of rows) shown += !(row.hidden = !selects.every(s => fits(row, s)));
    for (const part of document.querySelectorAll("section"))
      part.hidden = [...part.querySelectorAll("tbody tr")].every(row => row.hidden);
    count.textContent = shown + " of " + rows.length + " rows";
  };
  for (const select of selects) select.addEventListener("change", show);
  for (const head of document.querySelectorAll(".board th")) {
    const button = document.createElement("button"), body = head.closest("table").tBodies[0];
    button.type = "button"; button.textContent = head.textContent; head.replaceChildren(button);
    button.addEventListener("click", () => {
      const figures = !head.classList.contains("text"), before = head.getAttribute("aria-sort");
      const way = before === (figures ? "descending" : "ascending") ? -1 : 1;
      for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", (way > 0) !== figures ? "ascending" : "descending");
      const value = row => figures ? row.cells[head.cellIndex].dataset.value : row.cells[head.cellIndex].textContent;
      const order = (a, b) => {
        const x = value(a), y = value(b);
        if (x === "" || y === "") return (x === "") - (y === "");
        return way * (figures ? y - x : x < y ? -1 : x > y ? 1 : 0);
      };
      body.append(...[...body.rows].sort(order));
    });
  }
  form.hidden = false; show();
});
