// Sorting and filtering of the board, and the comparison of chosen entries. The board is complete and
// readable without it. Text from submitters is only ever set as text, never parsed as HTML.
"use strict";

const SVG = "http://www.w3.org/2000/svg";
const MAX_ENTRIES = 6; // that can be distinguished in one chart

function make(name, attributes = {}, ...children) {
  const svg = ["svg", "path", "polyline", "g"].includes(name);
  const element = svg ? document.createElementNS(SVG, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function formatted(value, digits = 3) {
  const text = value.toFixed(digits);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "\u2212");
}

// The board

function enhanceBoard(table) {
  const tools = document.querySelector("[data-tools]");
  const status = tools.querySelector("[data-status]");
  const bodies = [...table.querySelectorAll("tbody[data-rows]")];
  const rows = bodies.flatMap((body) => [...body.querySelectorAll("tr[data-family]")]);

  const filters = [...tools.querySelectorAll("[data-filter]")];
  const filter = () => {
    const wanted = Object.fromEntries(filters.map((field) => [field.dataset.filter, field.value]));
    const text = wanted.text.trim().toLocaleLowerCase();
    let left = 0;
    for (const row of rows) {
      const name = row.querySelector(".name").textContent.toLocaleLowerCase();
      row.hidden = Boolean(
        (wanted.family && row.dataset.family !== wanted.family) ||
          (wanted.knowledge && row.dataset.knowledge !== wanted.knowledge) ||
          (text && !name.includes(text)),
      );
      left += row.hidden ? 0 : 1;
    }
    status.textContent = left === rows.length ? "" : `${left} of ${rows.length} entries shown`;
  };
  for (const field of filters) field.addEventListener("input", filter);
  tools.hidden = false;

  enhanceSorting(table, tools, bodies);

  const boxes = [...table.querySelectorAll("input[name=id]")];
  const note = document.querySelector("[data-chosen]");
  const count = () => {
    const chosen = boxes.filter((box) => box.checked).length;
    note.textContent = chosen ? `${chosen} of at most ${MAX_ENTRIES} selected.` : `Select up to ${MAX_ENTRIES} entries.`;
    for (const box of boxes) box.disabled = !box.checked && chosen >= MAX_ENTRIES;
  };
  table.addEventListener("change", count);
  window.addEventListener("pageshow", count); // going back restores the selection without an event
  count();
}

// Headers sort a wide table. A narrow one has no headers, so the same sorting has a list and a button.
function enhanceSorting(table, tools, bodies) {
  const heads = [...table.tHead.rows[0].cells];
  const list = tools.querySelector("[data-sort-by]");
  const direction = tools.querySelector("[data-sort-order]");
  const order = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });
  const arrived = bodies.map((body) => [...body.querySelectorAll("tr[data-family]")]);

  const sort = (column, down) => {
    for (const head of heads) head.removeAttribute("aria-sort");
    heads[column].setAttribute("aria-sort", down ? "descending" : "ascending");
    list.value = String(column);
    direction.textContent = down ? "Descending" : "Ascending";
    const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
    const compare =
      heads[column].dataset.sort === "number"
        ? (a, b) => Number(key(a)) - Number(key(b))
        : (a, b) => order.compare(key(a), key(b));
    bodies.forEach((body, index) => {
      body.append(...[...arrived[index]].sort((a, b) => (down ? compare(b, a) : compare(a, b))));
    });
  };

  heads.forEach((head, column) => {
    if (!head.dataset.sort) return;
    const button = make("button", { type: "button" }, head.textContent);
    list.append(make("option", { value: column }, head.textContent));
    head.replaceChildren(button);
    button.addEventListener("click", () => sort(column, head.getAttribute("aria-sort") === "ascending"));
  });
  list.addEventListener("change", () => sort(Number(list.value), false));
  direction.addEventListener("click", () => sort(Number(list.value), direction.textContent === "Ascending"));
}

// The comparison

function enhanceComparison(place) {
  const { entries, regions, metrics } = window.boardData;
  const part = (name) => place.querySelector(`[data-${name}]`);
  let chosen = idsOf(location)
    .map((id) => entries.find((entry) => entry.id.startsWith(id)))
    .filter((entry, index, all) => entry && all.indexOf(entry) === index)
    .slice(0, MAX_ENTRIES);

  const choose = (next) => {
    chosen = next;
    const query = chosen.map((entry) => `id=${entry.id.slice(0, 16)}`).join("&");
    // A page opened from a file may not change its address. Only the link is lost then.
    try {
      history.replaceState(null, "", query ? `?${query}` : location.pathname);
    } catch {}
    draw();
  };
  const label = (entry) => `${entry.name}, by ${entry.by}`;

  const add = part("add");
  add.addEventListener("change", () => {
    const entry = entries.find((candidate) => candidate.id === add.value);
    if (entry) choose([...chosen, entry]);
  });

  function draw() {
    add.replaceChildren(
      make("option", { value: "" }, "choose…"),
      ...entries
        .filter((entry) => !chosen.includes(entry))
        .map((entry) => make("option", { value: entry.id }, label(entry))),
    );
    add.disabled = chosen.length >= MAX_ENTRIES;
    part("status").textContent = status(chosen.length);
    part("legend").replaceChildren(...chosen.map(legendItem));
    part("figure").hidden = chosen.length === 0;
    drawCurves(part("figure").querySelector("svg"), chosen, label);
    part("table").parentNode.hidden = chosen.length === 0;
    part("table").replaceChildren(...(chosen.length ? table(chosen, regions, metrics) : []));
  }

  function legendItem(entry, index) {
    const remove = make("button", { type: "button" }, "Remove");
    remove.setAttribute("aria-label", `Remove ${label(entry)}`);
    remove.addEventListener("click", () => {
      choose(chosen.filter((other) => other !== entry));
      add.focus();
    });
    const link = make("a", { href: `submissions/${entry.id}.html` }, make("bdi", {}, entry.name));
    const by = make("bdi", { class: "muted" }, `by ${entry.by}`);
    return make("li", {}, key(index), make("span", {}, link, " ", by), remove);
  }

  draw();
  place.hidden = false;
  document.querySelector("[data-without]").hidden = true;
}

function status(count) {
  if (count === 0) return "No entry is selected. Add entries here, or select them on the board.";
  if (count === 1) return "One entry. Add another to compare them.";
  if (count < MAX_ENTRIES) return `${count} entries, compared with the first.`;
  return `${count} entries, the maximum. Remove one to add another.`;
}

function idsOf(address) {
  const query = new URLSearchParams(address.search).getAll("id");
  const ids = query.length ? query : address.hash.slice(1).split(",");
  return ids.filter((id) => /^[0-9a-f]{8,64}$/.test(id));
}

function key(index) {
  return make(
    "svg",
    { class: `key series-${index}`, viewBox: "0 0 44 16", "aria-hidden": "true" },
    make("path", { class: "line", d: "M0 8H44" }),
    mark(index, 22, 8),
  );
}

// Each series has its own shape: disc, square, triangle up, diamond, triangle down, cross.
function mark(index, x, y) {
  const shapes = [
    `M${x - 5} ${y}a5 5 0 1 0 10 0a5 5 0 1 0 -10 0`,
    `M${x - 4.5} ${y - 4.5}h9v9h-9z`,
    `M${x} ${y - 6}l5.5 10h-11z`,
    `M${x} ${y - 6.5}l5.5 6.5l-5.5 6.5l-5.5 -6.5z`,
    `M${x} ${y + 6}l5.5 -10h-11z`,
    `M${x - 2} ${y - 6}h4v4h4v4h-4v4h-4v-4h-4v-4h4z`,
  ];
  return make("path", { class: "mark", d: shapes[index] });
}

// The server drew the axes; this draws the chosen entries on them, next to one another.
function drawCurves(svg, chosen, label) {
  const [left, step, zero, one] = ["left", "step", "zero", "one"].map((name) => Number(svg.dataset[name]));
  const y = (value) => zero + (one - zero) * value;
  const apart = Math.min(12, (step * 0.7) / chosen.length);
  svg.querySelectorAll(".overlay").forEach((curve) => curve.remove());
  svg.querySelector("desc").textContent =
    `${chosen.map(label).join("; ")}. The table below has the numbers.`;
  chosen.forEach((entry, series) => {
    const x = (region) => left + step * (region + 0.5) + apart * (series - (chosen.length - 1) / 2);
    const points = entry.normalised_regret.map(([value], region) => `${x(region)},${y(value)}`);
    const curve = make("g", { class: `overlay series-${series}` });
    curve.append(make("polyline", { class: "line", points: points.join(" ") }));
    entry.normalised_regret.forEach(([value, low, high], region) => {
      const at = x(region);
      const ends = `M${at} ${y(low)}V${y(high)}M${at - 3} ${y(low)}h6M${at - 3} ${y(high)}h6`;
      if (low !== null) curve.append(make("path", { class: "whisker", d: ends }));
      curve.append(mark(series, at, y(value)));
    });
    svg.append(curve);
  });
}

function table(chosen, regions, metrics) {
  const names = chosen.map((entry, index) =>
    make("th", { scope: "col", class: `n series-${index}` }, key(index), make("bdi", {}, entry.name)),
  );
  const head = make("tr", {}, make("th", { scope: "col" }, "Score"), ...names);
  const row = (name, estimates, digits) => {
    const [base] = estimates;
    const cells = estimates.map(([value, low, high], index) => {
      // An entry with a single run in each class has no interval: its ends are null.
      const known = low !== null;
      const text = known ? `${formatted(low, digits)} to ${formatted(high, digits)}` : "no interval";
      const range = make("span", {}, text);
      const cell = make("td", { class: "n estimate" }, make("strong", {}, formatted(value, digits)), range);
      if (index > 0) {
        const difference = value - base[0];
        const apart = known && base[1] !== null && (low > base[2] || high < base[1]);
        const sign = Number(difference.toFixed(digits)) > 0 ? "+" : "";
        const kind = apart ? "diff apart" : "diff";
        cell.append(make("span", { class: kind }, `Δ ${sign}${formatted(difference, digits)}`));
      }
      return cell;
    });
    return make("tr", {}, make("th", { scope: "row" }, name), ...cells);
  };
  const scores = metrics.map((name, index) =>
    row(name, chosen.map((entry) => entry.scores[index]), name === "Similarity loss" ? 2 : 3),
  );
  const regrets = regions.map((name, index) =>
    row(index === 0 ? "N, WD" : `N, ε ${name}`, chosen.map((entry) => entry.normalised_regret[index]), 3),
  );
  const caption = make("span", {}, "Value, 95 % interval, and the difference Δ to the first entry.");
  return [make("caption", {}, caption), make("thead", {}, head), make("tbody", {}, ...scores, ...regrets)];
}

const boardTable = document.querySelector("[data-board]");
if (boardTable) enhanceBoard(boardTable);
const comparison = document.querySelector("[data-compare]");
if (comparison && window.boardData) enhanceComparison(comparison);
