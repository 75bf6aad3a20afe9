"use strict";
// Pictures of lines: the values at one place, and a part of the axis made larger. All of it is on the page without.
(() => {
const NS = "http://www.w3.org/2000/svg", SLIDES = 400, LEAST = 1e-4;
const LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
const made = (tag, inside, values = {}) => {
  const element = inside.namespaceURI === NS ? document.createElementNS(NS, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(values)) element.setAttribute(name, value);
  return inside.appendChild(element);
};
const digits = span => Math.max(0, Math.min(6, 2 - Math.floor(Math.log10(Math.abs(span) || 1))));
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// A path as its commands with absolute points; only M, L, l and z are drawn by lines.
function parsed(text) {
  const found = [];
  let at = [0, 0];
  for (const [, command, rest] of text.matchAll(/([A-Za-z])([^A-Za-z]*)/g)) {
    const n = (rest.match(/-?(?:\d+\.?\d*|\.\d+)/g) || []).map(Number);
    if (command === "z" || !n.length) found.push(["z"]);
    else if (command === "C" || command === "Q") found.push([command, ...n]);
    else for (let i = 0; i < n.length; i += 2) {
      at = command === "l" ? [at[0] + n[i], at[1] + n[i + 1]] : [n[i], n[i + 1]];
      found.push([command === "M" && !i ? "M" : "L", ...at]);
    }
  }
  return found;
}
const drawn = (path, x) => path.map(([c, ...n]) => c + n.map((v, i) => (i % 2 ? v : x(v)).toFixed(2)).join(" ")).join("");

// A rule or a ground across the whole panel stays where it is.
function across(path, [left, , right]) {
  const x = path.flatMap(([, ...n]) => n.filter((_, i) => i % 2 === 0)), y = new Set(path.map(p => p[2]));
  return path.length < 7 && (path.length > 2 || y.size === 1) &&
    Math.abs(Math.min(...x) - left) < 0.1 && Math.abs(Math.max(...x) - right) < 0.1;
}

function panelOf(svg, told, runs) {
  const root = svg.getElementById(told.id), [left, top, right, bottom] = told.box;
  const [x0, x1] = told.log[0] ? told.x.map(Math.log10) : told.x;
  const [y0, y1] = told.log[1] ? told.y.map(Math.log10) : told.y;
  const panel = {...told, svg, root, movers: [], ticks: [...root.querySelectorAll(".xtick")]};
  panel.labelled = panel.ticks.some(tick => tick.querySelector("text"));
  const toData = v => x0 + (v - left) / (right - left) * (x1 - x0);
  const paths = new Set();
  for (const element of root.querySelectorAll("[clip-path]")) {
    if (element.closest(".xtick, .ytick")) continue;
    for (const part of [element, ...element.querySelectorAll("path, use")]) {
      if (part.tagName === "use" && +part.getAttribute("x")) {
        const x = +part.getAttribute("x");
        panel.movers.push(map => part.setAttribute("x", map(x)));
      }
      const path = part.tagName === "use" ? svg.getElementById(part.getAttribute("xlink:href").slice(1)) : part;
      if (path.tagName === "path" && !(part.tagName === "use" && +part.getAttribute("x"))) paths.add(path);
    }
  }
  panel.lines = told.lines.map(line => {
    const path = svg.getElementById(line.id).querySelector("path"), points = parsed(path.getAttribute("d"));
    const of = v => { const y = y0 + (bottom - v) / (bottom - top) * (y1 - y0); return told.log[1] ? 10 ** y : y; };
    const own = {label: line.label, colour: path.style.stroke, path, points: points.filter(p => p[0] !== "z").map(
      ([c, x, y]) => [toData(x), of(y), c === "M"])};
    if (line.rows) {
      let i = 0;
      own.fine = runs.flatMap(([begin, step, count]) => Array.from({length: count}, (_, k) => {
        const level = 64 * LETTERS.indexOf(line.rows[i++]) + LETTERS.indexOf(line.rows[i++]);
        return [begin + k * step, y0 + level / 4095 * (y1 - y0), k === 0];
      }));
      const whole = path.getAttribute("d");
      paths.delete(path);
      panel.movers.push((map, zoomed) => path.setAttribute("d", zoomed ? refined(panel, own.fine, map) : whole));
    }
    return own;
  });
  for (const path of paths) {
    const whole = path.getAttribute("d"), points = parsed(whole);
    if (!across(points, told.box)) panel.movers.push((map, zoomed) => path.setAttribute("d", zoomed ? drawn(points, map) : whole));
  }
  panel.y01 = [y0, y1];
  panel.x01 = [x0, x1];
  return panel;
}

// Of the rows in sight at most two a point: the least and the greatest value.
function refined({box: [left, top, right, bottom], x01: [x0, x1], y01: [y0, y1]}, rows, map) {
  const x = t => map(left + (t - x0) / (x1 - x0) * (right - left)), y = v => bottom - (v - y0) / (y1 - y0) * (bottom - top);
  let text = "", cell = null, some = [];
  const flush = () => {
    if (some.length > 2) {
      const by = [...some].sort((a, b) => a[1] - b[1]);
      some = [by[0], by[by.length - 1]].sort((a, b) => a[0] - b[0]);
    }
    for (const [t, v, first] of some) text += `${first || !text ? "M" : "L"}${x(t).toFixed(1)} ${y(v).toFixed(1)}`;
    some = [];
  };
  rows.forEach((row, i) => {
    const at = x(row[0]);
    if (at < left && (!rows[i + 1] || x(rows[i + 1][0]) < left)) return;
    if (at > right && i && x(rows[i - 1][0]) > right) return;
    if (Math.floor(at) !== cell || row[2]) flush();
    cell = Math.floor(at);
    some.push(row);
  });
  flush();
  return text || "M0 0";
}

// Between two points of a line; null where it is broken or has ended.
function valueAt({points, fine}, x) {
  const some = fine || points;
  let low = 0, high = some.length - 1;
  if (!some.length || x < some[0][0] || x > some[high][0]) return null;
  while (high - low > 1) { const m = (low + high) >> 1; if (some[m][0] <= x) low = m; else high = m; }
  const [a, b] = [some[low], some[high]];
  if (x === a[0] || b === a) return a[1];
  return b[2] ? null : a[1] + (b[1] - a[1]) * (x - a[0]) / (b[0] - a[0] || 1);
}

function plotOf(svg, runs, finer) {
  const told = JSON.parse(svg.dataset.curves);
  told.panels.forEach((panel, k) => panel.lines.forEach((line, i) => {
    const other = finer && finer.panels[k] && finer.panels[k].lines[i];
    if (other && other.label === line.label && String(panel.y) === String(finer.panels[k].y)) line.rows ||= other.rows;
  }));
  const panels = told.panels.map(panel => panelOf(svg, panel, told.runs || runs || []));
  return {svg, panels: panels.filter(p => String(p.x) === String(panels[0].x))};
}

function explore(figure, svgs) {
  const finer = JSON.parse(svgs[0].dataset.curves);
  const plots = svgs.map(svg => plotOf(svg, finer.runs, finer));
  const first = plots[0].panels[0], [x0, x1] = first.x01, log = Boolean(first.log[0]);
  const fixed = !/^time(,| \[|$)/.test(first.along);
  const [, quantity, unit] = first.along.match(/^(.*?)(?: \[(.*)\])?$/);
  const back = x => log ? 10 ** x : x;
  let view = [x0, x1], cursor = null, began = null;
  const [tools, readout] = ["div", "p"].map(tag => {
    const element = document.createElement(tag);
    figure.insertBefore(element, figure.querySelector("figcaption, details"));
    return element;
  });
  tools.className = "tools";
  readout.className = "readout";
  readout.textContent = fixed ? "Point at a line for its values." : "Point at a line for its values; drag along a part to make it larger.";
  const slider = made("input", tools, {type: "range", min: 0, max: SLIDES, value: 0, "aria-label": `${quantity || "place"} to read the lines at`});
  const buttons = fixed ? [] : [["zoom in", () => zoom(0.5)], ["zoom out", () => zoom(2)], ["whole", () => show([x0, x1])]];
  for (const [text, act] of buttons) {
    const button = made("button", tools, {type: "button", tabindex: -1});
    button.textContent = text;
    button.addEventListener("click", act);
  }
  if (!fixed) slider.setAttribute("aria-keyshortcuts", "+ - Shift+ArrowLeft Shift+ArrowRight Escape");
  for (const plot of plots) for (const panel of plot.panels)
    panel.mark = made("line", plot.svg, {class: "mark", y1: panel.box[1], y2: panel.box[3], visibility: "hidden"});

  const place = (panel, x) => panel.box[0] + (x - view[0]) / (view[1] - view[0]) * (panel.box[2] - panel.box[0]);
  function read(x) {
    cursor = clamp(x, ...view);
    const at = back(cursor), parts = [];
    for (const panel of plots[0].panels) {
      const [, name, of] = panel.of.match(/^(.*?)(?: \[(.*)\])?$/), [a, b] = panel.y;
      for (const line of panel.lines) {
        const value = valueAt(line, cursor);
        if (value !== null) parts.push([line.label || name, panel.log[1] ? value.toPrecision(3) : value.toFixed(digits(b - a)), of || "", name]);
      }
    }
    const several = new Set(parts.map(p => p[3])).size > 1;
    const said = parts.map(([label, value, of, name], i) => (several && name !== label && (!i || parts[i - 1][3] !== name) ? `${name}: ` : "") +
      `${label} ${value}${of && of !== "-" ? " " + of : ""}`).join(", ");
    const text = `${log ? at.toPrecision(3) : at.toFixed(digits(view[1] - view[0]))} ${unit || ""}: ${said || "no line here"}`;
    readout.textContent = text;
    slider.value = (cursor - view[0]) / (view[1] - view[0]) * SLIDES;
    slider.setAttribute("aria-valuetext", text);
    mark();
  }
  function mark() {
    for (const plot of plots) for (const panel of plot.panels) {
      panel.mark.setAttribute("visibility", cursor === null ? "hidden" : "visible");
      if (cursor !== null) for (const end of ["x1", "x2"]) panel.mark.setAttribute(end, place(panel, cursor));
    }
  }
  function show(next) {
    const span = clamp(next[1] - next[0], LEAST * (x1 - x0), x1 - x0), begin = clamp(next[0], x0, x1 - span);
    view = [begin, begin + span];
    const zoomed = span < x1 - x0;
    figure.classList.toggle("zoomed", zoomed);
    for (const plot of plots) for (const panel of plot.panels) {
      const [left, , right] = panel.box;
      const map = v => place(panel, x0 + (v - left) / (right - left) * (x1 - x0));
      for (const move of panel.movers) move(map, zoomed);
      ticks(panel, zoomed);
    }
    if (cursor !== null) read(cursor);
  }
  function ticks(panel, zoomed) {
    for (const tick of panel.ticks) tick.style.display = zoomed ? "none" : "";
    if (panel.extra) panel.extra.remove();
    panel.extra = null;
    if (!zoomed || !panel.ticks.length) return;
    const [left, top, right, bottom] = panel.box, most = (right - left) / 80, span = view[1] - view[0];
    const rough = 10 ** Math.floor(Math.log10(span / most)), step = rough * [1, 2, 5, 10].find(m => span / (rough * m) <= most);
    panel.extra = document.createElementNS(NS, "g");
    panel.ticks[0].before(panel.extra);
    for (let k = Math.ceil(view[0] / step); k * step <= view[1]; k++) {
      const x = place(panel, k * step);
      made("line", panel.extra, {class: "grid", x1: x, x2: x, y1: top, y2: bottom});
      const like = panel.labelled && panel.ticks.map(t => t.querySelector("text")).find(Boolean);
      if (!like || x - left < 8 || right - x < 8) continue;
      const text = panel.extra.appendChild(like.cloneNode());
      text.textContent = (k * step).toFixed(Math.max(0, -Math.floor(Math.log10(step))));
      text.removeAttribute("transform");
      text.setAttribute("x", x);
    }
  }
  function zoom(factor, about = cursor === null ? (view[0] + view[1]) / 2 : cursor) {
    if (!fixed) show(view.map(end => about + (end - about) * factor));
  }
  const pan = share => show(view.map(end => end + share * (view[1] - view[0])));

  slider.addEventListener("input", () => read(view[0] + slider.value / SLIDES * (view[1] - view[0])));
  slider.addEventListener("focus", () => read(cursor === null ? view[0] : cursor));
  slider.addEventListener("keydown", event => {
    const act = {"+": () => zoom(0.5), "=": () => zoom(0.5), "-": () => zoom(2), Escape: () => show([x0, x1])}[event.key] ||
      (event.shiftKey && {ArrowLeft: () => pan(-0.25), ArrowRight: () => pan(0.25)}[event.key]);
    if (!act || fixed || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    act();
  });
  for (const {svg, panels} of plots) {
    const where = event => {
      const p = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse()), [left, , right] = panels[0].box;
      const panel = panels.find(({box}) => p.x >= box[0] && p.x <= box[2] && p.y >= box[1] && p.y <= box[3]);
      const of = began ? began.panel : panel;
      return of && {panel: of, x: view[0] + clamp((p.x - of.box[0]) / (of.box[2] - of.box[0]), 0, 1) * (view[1] - view[0])};
    };
    const ground = made("rect", svg, {class: "chosen", visibility: "hidden"});
    const stop = () => { began = null; ground.setAttribute("visibility", "hidden"); };
    svg.addEventListener("pointerdown", event => {
      const at = where(event);
      if (!at || event.button) return;
      began = {...at, clientX: event.clientX};
      svg.setPointerCapture(event.pointerId);
      read(at.x);
    });
    svg.addEventListener("pointermove", event => {
      const at = where(event);
      if (!at) return;
      read(at.x);
      if (!began || fixed || Math.abs(event.clientX - began.clientX) < 8) return;
      const ends = [began.x, at.x].map(x => place(at.panel, x)).sort((a, b) => a - b), [, top, , bottom] = at.panel.box;
      for (const [name, value] of Object.entries({x: ends[0], width: ends[1] - ends[0], y: top, height: bottom - top, visibility: "visible"}))
        ground.setAttribute(name, value);
    });
    svg.addEventListener("pointerup", event => {
      const at = began && where(event), from = began;
      stop();
      if (at && !fixed && Math.abs(event.clientX - from.clientX) >= 8) show([from.x, at.x].sort((a, b) => a - b));
      slider.focus({preventScroll: true});
    });
    svg.addEventListener("pointercancel", stop);
    svg.addEventListener("pointerleave", () => { if (!began && document.activeElement !== slider) { cursor = null; mark(); } });
    svg.addEventListener("dblclick", () => show([x0, x1]));
    svg.addEventListener("wheel", event => {
      // a page is scrolled by the wheel, until its reader has chosen this picture
      const at = where(event);
      if (!at || fixed || !(event.ctrlKey || event.metaKey || figure.contains(document.activeElement))) return;
      event.preventDefault();
      zoom(event.deltaY < 0 ? 0.8 : 1.25, at.x);
    }, {passive: false});
  }
  figure.classList.add("live");
  addEventListener("beforeprint", () => { show([x0, x1]); cursor = null; mark(); });
}

for (const figure of document.querySelectorAll("figure")) {
  const svgs = [...figure.querySelectorAll("svg[data-curves]")];
  if (svgs.length) explore(figure, svgs);
}
})();
