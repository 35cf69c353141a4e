// Line charts in SVG, drawn at the width of their container and again when it changes.

// Lines are told apart by the classes c0, c1, … (Okabe and Ito's colours, as in all figures; `ink` is
// the text's) and by their dashes.
const DASHES = ["", "7 3", "2 3", "8 2 1 2"];

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "class") made.className = value;
    else if (key in made && typeof value !== "string") made[key] = value;
    else made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

function svg(name, attributes = {}, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

// `0.44`, `−0.02`; no negative zero.
function fixed(value, digits = 2) {
  if (value === null || Number.isNaN(value)) return "–";
  const text = value.toFixed(digits);
  return (Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−"));
}

// About `count` round numbers from low to high.
function ticks(low, high, count = 5) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 2.5, 5, 10].find((each) => each * power >= rough) || 10);
  const first = Math.ceil(low / step - 1e-9), last = Math.floor(high / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, i) => (first + i) * step);
}

const shortNumber = (value) =>
  Math.abs(value) >= 1000 ? value.toLocaleString("en") : String(Number(value.toPrecision(6))).replace("-", "−");

// options: x and y { label, low, high }, lines [{ name, x, y, colour, dash, marker }], and
// optionally band { name, x, low, high }, dots { name, x, y }, span [from, to], at.
function drawLines(figure, options) {
  const width = Math.max(figure.clientWidth, 240), height = Math.min(300, 0.62 * width + 40);
  const box = { left: 46, right: width - 10, top: 10, bottom: height - 40 };
  const { x, y } = options;
  const across = (v) => box.left + ((v - x.low) / (x.high - x.low)) * (box.right - box.left);
  const up = (v) => box.bottom - ((v - y.low) / (y.high - y.low)) * (box.bottom - box.top);
  const chart = svg("svg", {
    viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": options.title,
  });
  if (options.span) {
    const [from, to] = options.span.map((v) => across(Math.min(Math.max(v, x.low), x.high)));
    chart.append(svg("rect", {
      class: "span", x: from, y: box.top, width: Math.max(0, to - from), height: box.bottom - box.top,
    }));
  }
  for (const value of x.ticks || ticks(x.low, x.high, width < 420 ? 4 : 6)) {
    chart.append(
      svg("line", { class: "grid", x1: across(value), x2: across(value), y1: box.top, y2: box.bottom }),
      svg("text", { x: across(value), y: box.bottom + 16, "text-anchor": "middle" },
        x.names ? x.names[value] : shortNumber(value)),
    );
  }
  for (const value of ticks(y.low, y.high)) {
    chart.append(
      svg("line", { class: "grid", x1: box.left, x2: box.right, y1: up(value), y2: up(value) }),
      svg("text", { x: box.left - 6, y: up(value) + 4, "text-anchor": "end" }, shortNumber(value)),
    );
  }
  chart.append(svg("text", {
    x: (box.left + box.right) / 2, y: height - 6, "text-anchor": "middle", class: "label",
  }, x.label));
  const points = (xs, ys) => xs.map((v, i) => [v, ys[i]]).filter((p) => p[1] !== null)
    .map(([a, b]) => `${across(a).toFixed(1)},${up(b).toFixed(1)}`);
  if (options.band) {
    const { band } = options;
    const there = points(band.x, band.high), back = points(band.x, band.low).reverse();
    chart.append(svg("polygon", { class: "band", points: [...there, ...back].join(" ") }));
  }
  if (options.dots) {
    options.dots.x.forEach((v, i) => chart.append(svg("circle", {
      class: "dot", cx: across(v).toFixed(1), cy: up(options.dots.y[i]).toFixed(1), r: 1.8,
    })));
  }
  for (const line of options.lines) {
    chart.append(svg("polyline", {
      class: line.colour, points: points(line.x, line.y).join(" "), fill: "none",
      "stroke-width": line.width || 2, "stroke-dasharray": line.dash || "",
    }));
    if (line.marker) {
      for (const point of points(line.x, line.y)) {
        const [cx, cy] = point.split(",");
        chart.append(svg("circle", { class: line.colour, cx, cy, r: 3 }));
      }
    }
  }
  if (options.at !== undefined) {
    chart.append(svg("line", {
      class: "at", x1: across(options.at), x2: across(options.at), y1: box.top, y2: box.bottom,
    }));
  }
  const keys = [
    ...(options.dots ? [key(options.dots.name, svg("circle", { class: "dot", cx: 13, cy: 6, r: 2.5 }))] : []),
    ...options.lines.map((line) => key(line.name, svg("line", {
      class: line.colour, x1: 0, x2: 26, y1: 6, y2: 6, "stroke-width": 3,
      "stroke-dasharray": line.dash || "",
    }))),
    ...(options.band ? [key(options.band.name, svg("rect", { class: "band", width: 26, height: 12 }))] : []),
  ];
  figure.replaceChildren(
    element("p", { class: "axis" }, y.label), chart, element("ul", { class: "legend" }, ...keys),
  );
}

function key(name, shape) {
  return element("li", {}, svg("svg", { width: 26, height: 12, "aria-hidden": "true" }, shape), name);
}

// The numbers of a chart, for readers who do not see it.
function numbers(title, columns, rows) {
  const head = element("tr", {}, ...columns.map((name) => element("th", { scope: "col" }, name)));
  const body = rows.map(([first, ...rest]) => element("tr", {},
    element("th", { scope: "row" }, first), ...rest.map((cell) => element("td", {}, cell))));
  const table = element("table", {}, element("thead", {}, head), element("tbody", {}, ...body));
  const scroll = element("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": title }, table);
  return element("details", {}, element("summary", {}, "The numbers"), scroll);
}
