// What needs a script: sorting and filtering the board, and laying chosen entries over one another.
// Without it the board is whole and readable. No text is ever read as HTML here: elements are made
// and texts are set, whatever a submitter wrote.
"use strict";

const SVG = "http://www.w3.org/2000/svg";
const MOST = 6; // entries that can be told apart in one drawing

function make(name, attributes = {}, ...children) {
  const svg = ["svg", "path", "polyline", "text", "g", "title", "desc"].includes(name);
  const element = svg ? document.createElementNS(SVG, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function shown(value, digits = 3) {
  const text = value.toFixed(digits);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "\u2212");
}

// The board

function enhanceBoard(table) {
  const tools = document.querySelector("[data-tools]");
  const said = tools.querySelector("[data-said]");
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
    said.textContent = left === rows.length ? "" : `${left} of ${rows.length} entries shown`;
  };
  for (const field of filters) field.addEventListener("input", filter);
  tools.hidden = false;

  const heads = [...table.tHead.rows[0].cells];
  const order = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });
  heads.forEach((head, column) => {
    if (!head.dataset.sort) return;
    const button = make("button", { type: "button" }, head.textContent);
    head.replaceChildren(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
      const compare =
        head.dataset.sort === "number"
          ? (a, b) => Number(key(a)) - Number(key(b))
          : (a, b) => order.compare(key(a), key(b));
      for (const body of bodies) {
        const sorted = rows.filter((row) => row.parentNode === body).sort(compare);
        body.append(...(down ? sorted.reverse() : sorted));
      }
    });
  });

  const boxes = [...table.querySelectorAll("input[name=id]")];
  const note = document.querySelector("[data-chosen]");
  const count = () => {
    const chosen = boxes.filter((box) => box.checked).length;
    note.textContent = chosen ? `${chosen} of at most ${MOST} chosen.` : "Tick up to six entries.";
    for (const box of boxes) box.disabled = !box.checked && chosen >= MOST;
  };
  table.addEventListener("change", count);
  window.addEventListener("pageshow", count); // going back brings the ticks back, unannounced
  count();
}

// The comparison

function enhanceComparison(place) {
  const { entries, regions, metrics } = window.boardData;
  const part = (name) => place.querySelector(`[data-${name}]`);
  let chosen = idsOf(location)
    .map((id) => entries.find((entry) => entry.id.startsWith(id)))
    .filter((entry, index, all) => entry && all.indexOf(entry) === index)
    .slice(0, MOST);

  const choose = (next) => {
    chosen = next;
    const query = chosen.map((entry) => `id=${entry.id.slice(0, 16)}`).join("&");
    // A page opened from a file may not change its address; then only the link is lost.
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
    add.disabled = chosen.length >= MOST;
    part("said").textContent =
      chosen.length === 0
        ? "Nothing is chosen yet. Add entries here, or tick them on the board."
        : chosen.length >= MOST
          ? `${MOST} entries, as many as can be told apart. Take one away to add another.`
          : chosen.length === 1
            ? "One entry. Add another to see what lies between them."
            : `${chosen.length} entries, compared with the first.`;
    part("legend").replaceChildren(...chosen.map(legendItem));
    part("figure").hidden = chosen.length === 0;
    part("chart").replaceChildren(...(chosen.length ? [chart(chosen, regions, label)] : []));
    part("table").parentNode.hidden = chosen.length === 0;
    part("table").replaceChildren(...(chosen.length ? table(chosen, regions, metrics) : []));
  }

  function legendItem(entry, index) {
    const remove = make("button", { type: "button" }, "Take away");
    remove.setAttribute("aria-label", `Take away ${label(entry)}`);
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

function idsOf(address) {
  const asked = new URLSearchParams(address.search).getAll("id");
  const ids = asked.length ? asked : address.hash.slice(1).split(",");
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

// Each series has a shape of its own: disc, square, triangle up, diamond, triangle down, cross.
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

function ticksOf(values) {
  const low = Math.min(0, ...values);
  const high = Math.max(1, ...values);
  const raw = (high - low) / 4;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((factor) => factor * power).find((size) => size >= raw - 1e-12);
  const first = Math.floor(low / step + 1e-9);
  const last = Math.ceil(high / step - 1e-9);
  return Array.from({ length: last - first + 1 }, (_, index) => (first + index) * step);
}

function chart(chosen, regions, label) {
  const [width, height, left, right, top, bottom] = [720, 380, 60, 708, 22, 316];
  const ticks = ticksOf(chosen.flatMap((entry) => entry.normalised_regret.flat()));
  const [low, high] = [ticks[0], ticks[ticks.length - 1]];
  const y = (value) => bottom - ((bottom - top) * (value - low)) / (high - low);
  const step = (right - left) / regions.length;
  const apart = Math.min(12, (step * 0.7) / chosen.length);
  const x = (region, series) =>
    left + step * (region + 0.5) + apart * (series - (chosen.length - 1) / 2);
  const svg = make(
    "svg",
    { class: "profile", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-labelledby": "chart-title chart-desc" },
    make("title", { id: "chart-title" }, "Normalised regret by region"),
    make("desc", { id: "chart-desc" }, `${chosen.map(label).join("; ")}. The table below has the numbers.`),
  );
  for (const tick of ticks) {
    svg.append(
      make("path", { class: "grid", d: `M${left} ${y(tick)}H${right}` }),
      make("text", { class: "tick end", x: left - 8, y: y(tick) + 4 }, String(Number(tick.toFixed(6))).replace("-", "\u2212")),
    );
  }
  for (const [name, value, text] of [["optimal", 0, "optimal"], ["constant", 1, "constant ½"]]) {
    svg.append(
      make("path", { class: name, d: `M${left} ${y(value)}H${right}` }),
      make("text", { class: "tick label", x: right, y: y(value) - 6 }, text),
    );
  }
  const every = 1 + Math.floor((regions.length - 1) / 12);
  regions.forEach((text, region) => {
    if (region % every) return;
    svg.append(make("text", { class: "tick middle", x: left + step * (region + 0.5), y: bottom + 24 }, text));
  });
  svg.append(
    make("text", { class: "tick middle", x: (left + right) / 2, y: height - 10 }, "expansion ε beyond the training cube"),
  );
  chosen.forEach((entry, series) => {
    const group = make("g", { class: `overlay series-${series}` });
    const points = entry.normalised_regret.map(([value], region) => `${x(region, series)},${y(value)}`);
    group.append(make("polyline", { class: "line", points: points.join(" ") }));
    entry.normalised_regret.forEach(([value, from, to], region) => {
      const at = x(region, series);
      group.append(
        make("path", { class: "whisker", d: `M${at} ${y(from)}V${y(to)}M${at - 3} ${y(from)}h6M${at - 3} ${y(to)}h6` }),
        mark(series, at, y(value)),
      );
    });
    svg.append(group);
  });
  return svg;
}

function table(chosen, regions, metrics) {
  const head = make("tr", {}, make("th", { scope: "col" }, "Score"));
  chosen.forEach((entry, index) => {
    head.append(make("th", { scope: "col", class: `n series-${index}` }, key(index), make("bdi", {}, entry.name)));
  });
  const row = (name, estimates, digits) => {
    const [base] = estimates;
    const cells = estimates.map(([value, low, high], index) => {
      const range = make("span", {}, `${shown(low, digits)} to ${shown(high, digits)}`);
      const cell = make("td", { class: "n estimate" }, make("strong", {}, shown(value, digits)), range);
      if (index > 0) {
        const difference = value - base[0];
        const apart = low > base[2] || high < base[1];
        const sign = Number(difference.toFixed(digits)) > 0 ? "+" : "";
        const kind = apart ? "diff apart" : "diff";
        cell.append(make("span", { class: kind }, `Δ ${sign}${shown(difference, digits)}`));
      }
      return cell;
    });
    return make("tr", {}, make("th", { scope: "row" }, name), ...cells);
  };
  const body = make("tbody", {});
  metrics.forEach((name, index) => {
    body.append(row(name, chosen.map((entry) => entry.scores[index]), name === "Similarity loss" ? 2 : 3));
  });
  regions.forEach((name, index) => {
    const text = index === 0 ? "N, WD" : `N, ε ${name}`;
    body.append(row(text, chosen.map((entry) => entry.normalised_regret[index]), 3));
  });
  const caption = make(
    "caption",
    {},
    make("span", {}, "Value, 95 % interval, and the difference Δ to the first entry."),
  );
  return [caption, make("thead", {}, head), body];
}

const boardTable = document.querySelector("[data-board]");
if (boardTable) enhanceBoard(boardTable);
const comparison = document.querySelector("[data-compare]");
if (comparison && window.boardData) enhanceComparison(comparison);
