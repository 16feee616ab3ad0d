"use strict";
(function () {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  // Tables need no figures to be useful, so a page without them carries no plotting script.
  if (Object.keys(figures).length) window.tomoposeFigures = tomoposePlots.whenSeen(figures);

  // The button in a column's head sorts by it: numbers by value, words by alphabet; again turns the order.
  document.querySelectorAll("table.sortable thead button").forEach(function (button) {
    button.addEventListener("click", function () {
      const head = button.closest("th"), row = head.parentNode, column = Array.prototype.indexOf.call(row.children, head);
      const body = head.closest("table").tBodies[0], up = head.getAttribute("aria-sort") !== "ascending";
      Array.from(row.children).forEach(function (other) { if (other.hasAttribute("aria-sort")) other.setAttribute("aria-sort", "none"); });
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const key = function (r) { return r.children[column].textContent.trim(); };
      Array.from(body.rows).sort(function (a, b) {
        const x = key(a), y = key(b), p = parseFloat(x.replace("−", "-")), q = parseFloat(y.replace("−", "-"));
        return (up ? 1 : -1) * (isNaN(p) || isNaN(q) ? x.localeCompare(y, "en", { numeric: true }) : p - q);
      }).forEach(function (r) { body.appendChild(r); });
    });
  });
})();
