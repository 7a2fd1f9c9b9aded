// Figures, drawn anew where the colour scheme changes; colours of the light scheme have a partner in the dark one.
const scheme = matchMedia("(prefers-color-scheme: dark)");
function draw() {
  const partners = scheme.matches ? JSON.parse(document.getElementById("dark").textContent) : {};
  for (const place of document.querySelectorAll(".plot")) {
    let text = document.getElementById(place.id + "-data").textContent;
    text = text.replace(/"#[0-9a-f]{6}/g, (colour) => '"' + (partners[colour.slice(1)] ?? colour.slice(1)));
    const figure = JSON.parse(text);
    Plotly.react(place, figure.data, figure.layout, {
      responsive: true,
      displaylogo: false,
      showSendToCloud: false,
      plotlyServerURL: "",
      modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
      toImageButtonOptions: { format: "svg", filename: document.title + " " + place.id },
    });
  }
}
if (typeof Plotly !== "undefined") {
  document.getElementById("no-figures").remove();
  draw();
  scheme.addEventListener("change", draw);
}
// A click on a column's head sorts by it, a second click the other way round; gaps stay last.
for (const head of document.querySelectorAll("th")) {
  head.tabIndex = 0;
  head.addEventListener("keydown", (event) => event.key === "Enter" && head.click());
  head.addEventListener("click", () => {
    const body = head.closest("table").tBodies[0];
    const falling = head.ariaSort === "ascending";
    const key = (row) => row.cells[head.cellIndex].dataset.value ?? row.cells[head.cellIndex].textContent;
    const rows = [...body.rows].sort((a, b) => {
      const [x, y] = [key(a), key(b)];
      if (x === "" || y === "") return (x === "") - (y === "");
      return (falling ? -1 : 1) * (head.classList.contains("number") ? x - y : x.localeCompare(y));
    });
    for (const other of head.parentNode.cells) other.ariaSort = null;
    head.ariaSort = falling ? "descending" : "ascending";
    body.append(...rows);
  });
}
