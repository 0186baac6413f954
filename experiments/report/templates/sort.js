// Headings of tables of the class `sortable` become buttons that sort by their column.
"use strict";
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const value = (row) => row.cells[column].textContent.trim();
      const body = table.tBodies[0];
      const rows = [...body.rows].sort((a, b) => {
        const [x, y] = down ? [value(b), value(a)] : [value(a), value(b)];
        if (value(a) === "" || value(b) === "") return (value(a) === "") - (value(b) === "");
        const difference = parseFloat(x) - parseFloat(y); // the mean, before its interval
        return Number.isNaN(difference) ? x.localeCompare(y) : difference;
      });
      body.append(...rows);
    });
  });
}
