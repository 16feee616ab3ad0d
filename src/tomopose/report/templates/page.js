"use strict";
(function () {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const options = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["lasso2d", "select2d"] };
  // Tables need no figures to be useful, so a page without them carries no plotting script.
  const drawn = Object.keys(figures).map(function (name) {
    const figure = figures[name];
    return Plotly.newPlot(name, figure.data, figure.layout, options);
  });
  Promise.all(drawn).then(function () { document.body.dataset.figuresDrawn = String(drawn.length); });

  // A click on a column's head sorts by it: numbers by value, words by alphabet; a second click turns the order.
  document.querySelectorAll("table.sortable thead th").forEach(function (head) {
    head.title = "sort by this column";
    head.addEventListener("click", function () {
      const column = Array.prototype.indexOf.call(head.parentNode.children, head);
      const body = head.closest("table").tBodies[0];
      const sign = head.dataset.order === "up" ? -1 : 1;
      head.dataset.order = sign === 1 ? "up" : "down";
      const key = function (row) { return row.children[column].textContent.trim(); };
      Array.from(body.rows).sort(function (a, b) {
        const x = key(a), y = key(b), p = parseFloat(x.replace("−", "-")), q = parseFloat(y.replace("−", "-"));
        return sign * (isNaN(p) || isNaN(q) ? x.localeCompare(y, "en", { numeric: true }) : p - q);
      }).forEach(function (row) { body.appendChild(row); });
    });
  });
})();
