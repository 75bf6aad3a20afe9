"use strict";
// The ranking: searched, sorted and shown page by page. Text goes in as text, never as markup.
const { columns, numeric, rows } = JSON.parse(document.getElementById("rows").textContent);
const PAGE = 100;
const body = document.querySelector("#ranking tbody");
const find = document.getElementById("find"), why = document.getElementById("why"), by = document.getElementById("by");
const turn = document.getElementById("turn"), back = document.getElementById("back"), on = document.getElementById("on");
const seen = document.getElementById("seen");
const text = rows.map(row => row.slice(0, columns.length).join(" ").toLowerCase());
let turned = false, page = 0;

function number(cell) {
  const found = /-?\d+(\.\d+)?(e-?\d+)?/.exec(cell);
  return found ? parseFloat(found[0]) : null;
}

function key(column) {
  const name = columns[column];
  if (name === "car" || name === "why" || name === "simulator lacks") return row => row[column].toLowerCase();
  if (name === "own past") return row => number((/\(([\d.]+) SD/.exec(row[column]) || ["", ""])[1]);
  if (name === "siblings") return row => number((/tail <?([\de.-]+)/.exec(row[column]) || ["", ""])[1]);
  return row => number(row[column]);
}

function chosen() {
  const words = find.value.toLowerCase().split(/\s+/).filter(word => word);
  const left = rows.filter((row, i) => (!why.value || row[2] === why.value) && words.every(word => text[i].includes(word)));
  const of = key(Number(by.value)), keys = new Map(left.map(row => [row, of(row)]));
  const none = x => x === null || x === "";
  return left.sort((a, b) => {
    const x = keys.get(a), y = keys.get(b);
    // a car without the number is last, whichever way the others are sorted
    if (none(x) || none(y)) return none(x) - none(y);
    return (turned ? -1 : 1) * (x < y ? -1 : x > y ? 1 : 0);
  });
}

function line(row) {
  const tr = document.createElement("tr");
  tr.setAttribute("role", "row");
  columns.forEach((title, i) => {
    const cell = document.createElement(i ? "td" : "th");
    cell.setAttribute("role", i ? "cell" : "rowheader");
    if (i) cell.dataset.column = title; else cell.scope = "row";
    if (numeric.includes(title)) cell.classList.add("n");
    if (!row[i]) cell.classList.add("empty");
    const link = title === "car" ? row[columns.length] : "";
    if (link) {
      const a = document.createElement("a");
      a.href = link;
      a.textContent = row[i];
      cell.append(a);
    } else {
      cell.textContent = row[i];
    }
    tr.append(cell);
  });
  return tr;
}

function show() {
  const left = chosen(), pages = Math.max(1, Math.ceil(left.length / PAGE));
  page = Math.min(page, pages - 1);
  const first = page * PAGE, some = left.slice(first, first + PAGE);
  body.replaceChildren(...some.map(line));
  back.disabled = page === 0;
  on.disabled = page === pages - 1;
  seen.textContent = left.length ? `Cars ${first + 1} to ${first + some.length} of ${left.length}` : "No car has these words";
}

find.addEventListener("input", () => { page = 0; show(); });
why.addEventListener("change", () => { page = 0; show(); });
by.addEventListener("change", () => { page = 0; show(); });
turn.addEventListener("click", () => { turned = !turned; turn.setAttribute("aria-pressed", turned); page = 0; show(); });
back.addEventListener("click", () => { page -= 1; show(); });
on.addEventListener("click", () => { page += 1; show(); });
for (const part of document.querySelectorAll(".controls")) part.hidden = false;
document.getElementById("rest").hidden = true;
show();
