"use strict";
// The ranking: searched, sorted and shown page by page. Text goes in as text, never as markup.
const PAGE = 100, $ = id => document.getElementById(id);
const { columns, numeric, rows } = JSON.parse($("rows").textContent);
const text = rows.map(row => row.slice(0, columns.length).join(" ").toLowerCase());
let page = 0;

function key(name) {
  const column = columns.indexOf(name), number = found => (found ? parseFloat(found[1]) : null);
  const pattern = { "own past": /\(([\d.]+) SD/, siblings: /tail <?([\de.-]+)/ }[name] || /(-?\d+(?:\.\d+)?(?:e-?\d+)?)/;
  const words = ["car", "why", "simulator lacks"].includes(name);
  return row => (words ? row[column].toLowerCase() : number(pattern.exec(row[column])));
}

function chosen() {
  const words = $("find").value.toLowerCase().split(/\s+/).filter(Boolean), of = key($("by").value);
  const sign = $("turn").checked ? -1 : 1, none = x => x === null || x === "";
  return rows.filter((row, i) => (!$("why").value || row[2] === $("why").value) && words.every(w => text[i].includes(w)))
    .map(row => [of(row), row])
    // a car without the number is last, whichever way the others are sorted
    .sort(([x], [y]) => none(x) || none(y) ? none(x) - none(y) : sign * (x < y ? -1 : x > y ? 1 : 0)).map(([, row]) => row);
}

function line(row) {
  const tr = document.createElement("tr");
  tr.setAttribute("role", "row");
  columns.forEach((title, i) => {
    const cell = tr.appendChild(document.createElement(i ? "td" : "th")), link = i ? "" : row[columns.length];
    cell.setAttribute("role", i ? "cell" : "rowheader");
    if (i) cell.dataset.column = title; else cell.scope = "row";
    cell.classList.toggle("n", numeric.includes(title));
    cell.classList.toggle("empty", !row[i]);
    const inside = link ? cell.appendChild(document.createElement("a")) : cell;
    if (link) inside.href = link;
    inside.textContent = row[i];
  });
  return tr;
}

function show(next = 0) {
  const left = chosen(), pages = Math.max(1, Math.ceil(left.length / PAGE));
  page = Math.min(Math.max(next, 0), pages - 1);
  const first = page * PAGE, some = left.slice(first, first + PAGE);
  document.querySelector("#ranking tbody").replaceChildren(...some.map(line));
  $("back").disabled = page === 0;
  $("on").disabled = page === pages - 1;
  $("seen").textContent = left.length ? `Cars ${first + 1} to ${first + some.length} of ${left.length}` : "No car has these words";
}

for (const id of ["find", "why", "by", "turn"]) $(id).addEventListener("input", () => show());
$("back").addEventListener("click", () => show(page - 1));
$("on").addEventListener("click", () => show(page + 1));
for (const part of document.querySelectorAll(".controls")) part.hidden = false;
$("rest").hidden = true;
show();
