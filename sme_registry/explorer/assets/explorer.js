// The page: its controls, the map, and what it says of the state at the crosshair.

const data = JSON.parse(document.getElementById("data").textContent);
const model = new Model(data);
const { S, A, m } = data.task;
const N = 101; // points along a side of the map
const DRAFTS = [N, 51, 34, 26, 21, 11]; // coarser maps, while it is being changed
const DRAFT_MS = 45, SLICE_MS = 24;
const VIRIDIS = "440154,48186a,472d7b,424086,3b528b,33638d,2c728e,26828e,21918c,1fa088,28ae80,3fbc73,5ec962,84d44b,addc30,d8e219,fde725";
const BLUE_TO_ORANGE = "0072b2,579fca,a5c9e1,f4f4f4,ecbf9c,e08d53,d55e00"; // 0 in the middle

const $ = (id) => document.getElementById(id);

// Inputs of a point: state channels, distractors, t/T and r_cum/k.
const inputs = [
  ...Array.from({ length: S }, (_, i) => ({ name: `s${i + 1}`, label: `state channel ${i + 1}` })),
  ...Array.from({ length: m }, (_, i) => ({ name: `d${i + 1}`, label: `distractor ${i + 1}` })),
  { name: "t/T", label: "time t/T", unit: true },
  { name: "r_cum/k", label: "accumulated reward r_cum/k", unit: true },
];
const ownerOf = (channel) => {
  const agent = data.task.agents.find((each) => channel + 1 >= each.from && channel + 1 <= each.to);
  return agent ? `${channel + 1} (${agent.name})` : String(channel + 1);
};

// What a map can show. `of` maps the evaluated rows and a row to a number.
const QUANTITIES = [
  { key: "regret", label: "regret", own: true, range: [0, 1], of: (e, row) => model.regret(e.action, e.optimal, row) },
  { key: "similarity", label: "similarity r̃", own: true, range: [0, 1], of: (e, row) => model.similarity(e.action, e.optimal, row) },
  { key: "optimal", label: "optimal action", channel: true, range: [0, 1], of: (e, row, c) => e.optimal[row * A + c] },
  { key: "action", label: "chosen action", own: true, channel: true, range: [0, 1], of: (e, row, c) => e.action[row * A + c] },
  { key: "difference", label: "chosen − optimal", own: true, channel: true, range: [-1, 1], signed: true,
    of: (e, row, c) => e.action[row * A + c] - e.optimal[row * A + c] },
  ...(data.limit ? [
    { key: "cost", label: "cost", own: true, range: [0, 1], of: (e, row) => model.cost(e.action, e.limit, row) },
    { key: "optimal_cost", label: "cost of the optimum", range: [0, 1], of: (e, row) => model.cost(e.optimal, e.limit, row) },
    { key: "safe_regret", label: "safe regret", own: true, range: [-1, 1], signed: true, of: (e, row) => model.safeRegret(e.action, e.optimal, e.limit, row) },
    { key: "limit", label: "limit ℓ", channel: true, range: [0, 1], of: (e, row, c) => e.limit[row * A + c] },
  ] : []),
];

const view = {
  point: Float64Array.from(data.start),
  axes: [0, 1],
  epsilon: 1,
  channel: 0,
  quantity: QUANTITIES[0],
  policy: model.policies[0],
  full: false,
};
let map = null; // the newest map: { n, axes, low, high, evaluated }

const low = (input) => (inputs[input].unit ? 0 : -view.epsilon / 2);
const high = (input) => (inputs[input].unit ? 1 : 1 + view.epsilon / 2);
const gridOf = (policy, axes) => policy.grids.find((grid) => String(grid.axes) === String(axes));

// --- the map -------------------------------------------------------------------------------------

function pointsOfMap(n, firstRow, lastRow) {
  const [i, j] = view.axes;
  const points = new Float64Array((lastRow - firstRow) * n * inputs.length);
  let at = 0;
  for (let row = firstRow; row < lastRow; row++) {
    for (let column = 0; column < n; column++, at += inputs.length) {
      points.set(view.point, at);
      points[at + i] = low(i) + ((high(i) - low(i)) * column) / (n - 1);
      points[at + j] = low(j) + ((high(j) - low(j)) * row) / (n - 1);
    }
  }
  return points;
}

let job = 0; // the number of the newest computation; older ones stop
let secondsPerPoint = 2e-6;

async function compute() {
  const mine = ++job;
  document.documentElement.dataset.ready = "false";
  const grid = gridOf(view.policy, view.axes);
  if (grid) {
    const evaluated = evaluateRows(grid.n, 0, grid.n, grid.actions);
    finish(grid.n, evaluated);
    return;
  }
  const affordable = Math.sqrt(DRAFT_MS / 1000 / secondsPerPoint);
  const draft = DRAFTS.find((n) => n <= affordable) || DRAFTS[DRAFTS.length - 1];
  const begun = performance.now();
  const coarse = evaluateRows(draft, 0, draft);
  secondsPerPoint = Math.max(1e-8, (performance.now() - begun) / 1000 / draft ** 2);
  if (draft === N) {
    finish(N, coarse);
    return;
  }
  show(draft, coarse);
  const whole = emptyRows(N * N);
  for (let row = 0; row < N;) {
    await new Promise((resolve) => setTimeout(resolve, 0));
    const until = performance.now() + SLICE_MS;
    while (row < N && performance.now() < until) {
      if (mine !== job) return;
      const part = evaluateRows(N, row, row + 1);
      for (const name of Object.keys(part)) whole[name].set(part[name], row * N * A);
      row += 1;
    }
  }
  if (mine === job) finish(N, whole);
}

function emptyRows(rows) {
  const names = data.limit ? ["optimal", "action", "limit"] : ["optimal", "action"];
  return Object.fromEntries(names.map((name) => [name, new Float64Array(rows * A)]));
}

function evaluateRows(n, firstRow, lastRow, sampled = null) {
  return model.evaluate(pointsOfMap(n, firstRow, lastRow), (lastRow - firstRow) * n, view.policy, sampled);
}

function finish(n, evaluated) {
  show(n, evaluated);
  document.documentElement.dataset.ready = "true";
}

function show(n, evaluated) {
  const [i, j] = view.axes;
  map = { n, axes: [i, j], low: [low(i), low(j)], high: [high(i), high(j)], evaluated };
  drawMap();
}

function valuesOfMap() {
  const { of } = view.quantity;
  return Float64Array.from({ length: map.n * map.n }, (_, row) => of(map.evaluated, row, view.channel));
}

function rangeOf(values) {
  const { range, signed } = view.quantity;
  if (view.full) return range;
  let least = Infinity, most = -Infinity;
  for (const v of values) {
    if (v < least) least = v;
    if (v > most) most = v;
  }
  if (!(least <= most)) return range; // no finite number
  if (signed) {
    const end = Math.max(0.05, Math.ceil(Math.max(-least, most) / 0.05 - 1e-9) * 0.05);
    return [-end, end];
  }
  const first = Math.floor(least / 0.05 + 1e-9), last = Math.ceil(most / 0.05 - 1e-9);
  const top = Math.max(last, Math.round(range[0] / 0.05) + 1); // a map of the least value is not its most
  return [Math.min(first, top - 1) * 0.05, top * 0.05];
}

function colours(signed) {
  const stops = (signed ? BLUE_TO_ORANGE : VIRIDIS).split(",")
    .map((hex) => [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16)));
  return Array.from({ length: 256 }, (_, i) => {
    const u = (i / 255) * (stops.length - 1), k = Math.min(Math.floor(u), stops.length - 2);
    return stops[k].map((v, c) => Math.round(v + (u - k) * (stops[k + 1][c] - v)));
  });
}

function drawMap() {
  const values = valuesOfMap(), [least, most] = rangeOf(values), palette = colours(view.quantity.signed);
  const { n } = map, canvas = $("heat");
  canvas.width = canvas.height = n;
  const image = new ImageData(n, n);
  for (let row = 0; row < n; row++) {
    for (let column = 0; column < n; column++) {
      const v = (values[row * n + column] - least) / (most - least);
      const at = 4 * ((n - 1 - row) * n + column);
      const [r, g, b] = palette[Math.round(255 * Math.min(Math.max(v || 0, 0), 1))];
      image.data.set([r, g, b, Number.isNaN(v) ? 0 : 255], at);
    }
  }
  canvas.getContext("2d").putImageData(image, 0, 0);
  const scale = new ImageData(256, 1);
  palette.forEach((colour, i) => scale.data.set([...colour, 255], 4 * i));
  $("scale").getContext("2d").putImageData(scale, 0, 0);
  $("scale-ends").replaceChildren(
    element("span", {}, fixed(least)), element("span", {}, titleOfQuantity()), element("span", {}, fixed(most)),
  );
  drawMarks();
}

function titleOfQuantity() {
  const { label, channel } = view.quantity;
  return channel ? `${label}, channel ${ownerOf(view.channel)}` : label;
}

// Where a value of an axis is on the map, from 0 to 1. The outermost points lie half a cell inside.
function place(axis, value) {
  const share = (value - map.low[axis]) / (map.high[axis] - map.low[axis]);
  return (0.5 + share * (map.n - 1)) / map.n;
}

function drawMarks() {
  const canvas = $("marks"), side = $("surface").clientWidth, ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.height = Math.round(side * ratio);
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  const x = (value) => place(0, value) * side, y = (value) => side - place(1, value) * side;
  const [px, py] = view.axes.map((input) => view.point[input]);
  // Two strokes each, so that lines show on dark and on light colours.
  const twice = (path, outer, inner) => {
    for (const [colour, width] of [[outer, 3.5], [inner, 1.4]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.stroke(path);
    }
  };
  const cube = new Path2D(), cross = new Path2D();
  cube.rect(x(0), y(1), x(1) - x(0), y(0) - y(1));
  twice(cube, "#ffffff", "#000000");
  cross.arc(x(px), y(py), 6, 0, 2 * Math.PI);
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    cross.moveTo(x(px) + 6 * dx, y(py) + 6 * dy);
    cross.lineTo(x(px) + 15 * dx, y(py) + 15 * dy);
  }
  twice(cross, "#000000", "#ffffff");
  for (const [axis, id, side_] of [[0, "across-ticks", "left"], [1, "up-ticks", "bottom"]]) {
    const marks = ticks(map.low[axis], map.high[axis], 4).map((value) => {
      const mark = element("span", {}, shortNumber(Number(value.toFixed(6))));
      mark.style[side_] = `${100 * place(axis, value)}%`;
      return mark;
    });
    $(id).replaceChildren(...marks);
  }
  $("across-name").textContent = inputs[map.axes[0]].label;
  $("up-name").textContent = `↑ ${inputs[map.axes[1]].label}`;
}

// --- the state at the crosshair ------------------------------------------------------------------

// The map's number of the nearest grid point; of a sampled policy, which is known only there.
function sampledAt(grid, points, rows) {
  const actions = new Float64Array(rows * A);
  const index = (value, epsilon) => Math.min(Math.max(Math.round(((value + epsilon / 2) / (1 + epsilon)) * (grid.n - 1)), 0), grid.n - 1);
  for (let row = 0; row < rows; row++) {
    const [column, line] = grid.axes.map((axis) => index(points[row * inputs.length + axis], inputs[axis].unit ? 0 : grid.epsilon));
    const from = (line * grid.n + column) * A;
    actions.set(grid.actions.subarray(from, from + A), row * A);
  }
  return actions;
}

function evaluateAt(points, rows, policy = view.policy) {
  const grid = gridOf(policy, view.axes);
  return model.evaluate(points, rows, policy, grid ? sampledAt(grid, points, rows) : null);
}

let announcement = 0;

function describe() {
  const here = evaluateAt(view.point, 1);
  const regret = model.regret(here.action, here.optimal, 0);
  const similarity = model.similarity(here.action, here.optimal, 0);
  const E = model.expansion(view.point);
  const where = E <= 1e-9 ? "in the cube" : `outside the cube, at ε = ${fixed(E)}`;
  const [i, j] = view.axes;
  const place_ = [i, j].map((input) => `${inputs[input].name} = ${fixed(view.point[input])}`).join(", ");
  const parts = [`similarity ${fixed(similarity, 3)}`];
  if (here.limit) parts.push(`cost ${fixed(model.cost(here.action, here.limit, 0), 3)}`);
  $("reading").replaceChildren(
    element("strong", {}, `regret ${fixed(regret, 3)}`),
    ` of ${view.policy.name}, ${parts.join(", ")}. ${place_}; ${where}.`,
  );
  clearTimeout(announcement); // a screen reader hears where the crosshair stops
  announcement = setTimeout(() => { $("live").textContent = $("reading").textContent; }, 350);
  drawActions(here);
  drawProfile();
}

const MOST_ROWS = 64;

function drawActions(here) {
  const head = ["Channel", "", "optimal", "chosen", ...(here.limit ? ["limit"] : []), "difference"];
  $("actions").tHead.replaceChildren(element("tr", {}, ...head.map((name) => element("th", { scope: "col" }, name))));
  const rows = Array.from({ length: Math.min(A, MOST_ROWS) }, (_, c) => {
    const optimal = here.optimal[c], action = here.action[c], limit = here.limit && here.limit[c];
    const at = (v) => `${(4 + 92 * v).toFixed(2)}%`;
    const drawing = svg("svg", { "aria-hidden": "true" },
      svg("line", { class: "track", x1: at(0), x2: at(1), y1: 11, y2: 11 }),
      svg("line", { class: "gap", x1: at(optimal), x2: at(action), y1: 11, y2: 11 }),
      ...(here.limit ? [svg("line", { class: "limit-mark", x1: at(limit), x2: at(limit), y1: 2, y2: 20 })] : []),
      svg("circle", { class: "chosen-mark", cx: at(action), cy: 11, r: 4 }),
      svg("circle", { class: "optimal", cx: at(optimal), cy: 11, r: 6 }),
    );
    const numbers_ = [optimal, action, ...(here.limit ? [limit] : []), action - optimal];
    return element("tr", {},
      element("th", { scope: "row" }, ownerOf(c)), element("td", { class: "plot" }, drawing),
      ...numbers_.map((v) => element("td", {}, fixed(v, 3))));
  });
  $("actions").tBodies[0].replaceChildren(...rows);
  $("actions-note").hidden = A <= MOST_ROWS;
  $("actions-note").textContent = `The first ${MOST_ROWS} of ${A} channels.`;
}

function drawProfile() {
  const [i] = view.axes, points = new Float64Array(N * inputs.length);
  const xs = Array.from({ length: N }, (_, k) => low(i) + ((high(i) - low(i)) * k) / (N - 1));
  xs.forEach((x, k) => {
    points.set(view.point, k * inputs.length);
    points[k * inputs.length + i] = x;
  });
  const along = evaluateAt(points, N), of = (values) => xs.map((_, k) => values[k * A + view.channel]);
  $("profile-heading").textContent = `Action channel ${ownerOf(view.channel)}, along ${inputs[i].label}`;
  drawLines($("profile"), {
    title: `Optimal and chosen action of channel ${view.channel + 1} along ${inputs[i].label}`,
    x: { label: inputs[i].label, low: xs[0], high: xs[N - 1] },
    y: { label: "action", low: 0, high: 1 },
    span: [0, 1],
    at: view.point[i],
    lines: [
      { name: "optimal", x: xs, y: of(along.optimal), colour: "ink", width: 3 },
      { name: `chosen by ${view.policy.name}`, x: xs, y: of(along.action), colour: "c0", dash: "7 3" },
      ...(along.limit ? [{ name: "limit ℓ", x: xs, y: of(along.limit), colour: "c1", dash: "2 3" }] : []),
    ],
  });
}

// --- controls ------------------------------------------------------------------------------------

const sliders = inputs.map((input, index) => {
  const shown = element("span", { class: "value", "aria-hidden": "true" }); // no <output>: it is announced
  const slider = element("input", { type: "range", id: `input-${index + 1}`, step: "0.01" });
  slider.addEventListener("input", () => {
    view.point[index] = Number(slider.value);
    refresh(!view.axes.includes(index));
  });
  const label = element("label", { title: input.label }, element("span", {}, input.name), shown, slider);
  return { slider, shown, label };
});

function refreshSliders() {
  const fixedOthers = view.policy.of === "grid";
  sliders.forEach(({ slider, shown, label }, index) => {
    slider.min = String(low(index));
    slider.max = String(high(index));
    slider.value = String(view.point[index]);
    slider.disabled = fixedOthers && !view.axes.includes(index);
    slider.setAttribute("aria-label", inputs[index].label);
    shown.textContent = fixed(view.point[index]);
    label.classList.toggle("outside", view.point[index] < 0 || view.point[index] > 1);
    label.classList.toggle("chosen", view.axes.includes(index));
  });
}

// Everything that depends on the state; and the map, if it has changed.
function refresh(recompute) {
  refreshSliders();
  if (recompute || !map) compute();
  else drawMarks();
  describe();
}

function setOptions(select, entries, chosen) {
  select.replaceChildren(...entries.map(([value, text]) => element("option", { value: String(value) }, text)));
  select.value = String(chosen);
}

function refreshControls() {
  const { policy, quantity } = view;
  const sampled = policy.of === "grid";
  if (sampled) {
    view.epsilon = policy.grids[0].epsilon;
    if (!gridOf(policy, view.axes)) view.axes = [...policy.grids[0].axes];
    view.point = view.point.map((v, i) => (view.axes.includes(i) ? v : data.rest[i]));
  }
  view.point = view.point.map((v, i) => Math.min(Math.max(v, low(i)), high(i)));
  setOptions($("quantity"), QUANTITIES.map((q) => [q.key, q.label]), quantity.key);
  setOptions($("policy"), model.policies.map((p, i) => [i, p.name]), model.policies.indexOf(policy));
  $("policy-label").hidden = !quantity.own;
  setOptions($("channel"), Array.from({ length: A }, (_, c) => [c, ownerOf(c)]), view.channel);
  $("channel-label").hidden = A === 1;
  const choices = sampled
    ? [[...new Set(policy.grids.map((g) => g.axes[0]))], policy.grids.filter((g) => g.axes[0] === view.axes[0]).map((g) => g.axes[1])]
    : [inputs.map((_, i) => i), inputs.map((_, i) => i)];
  ["across", "up"].forEach((id, axis) => {
    setOptions($(id), choices[axis].map((i) => [i, inputs[i].name]), view.axes[axis]);
  });
  $("epsilon").value = String(view.epsilon);
  $("epsilon").disabled = sampled;
  $("epsilon-value").textContent = fixed(view.epsilon, 1);
  $("random").disabled = sampled;
  $("notice").hidden = !sampled;
  $("notice").textContent = sampled
    ? `The network of ${policy.name} is not one that this page can compute${policy.recurrent ? " (it is recurrent: its actions are those of its first step)" : ""}. `
      + `Its actions were sampled over ${policy.grids.map((g) => g.axes.map((i) => inputs[i].name).join(" and ")).join("; ")}, so the other sliders are off. `
      + "`sme diagnose --explore --channels` samples other channels."
    : "";
}

function changed() {
  refreshControls();
  refresh(true);
}

function setAxis(axis, input) {
  const other = 1 - axis;
  if (view.axes[other] === input) view.axes[other] = view.axes[axis];
  view.axes[axis] = input;
  const { policy } = view;
  if (policy.of === "grid" && !gridOf(policy, view.axes)) {
    view.axes = [...(policy.grids.find((g) => g.axes[axis] === input) || policy.grids[0]).axes];
  }
  changed();
}

function moveTo(x, y) {
  [x, y].forEach((value, axis) => {
    const input = view.axes[axis];
    view.point[input] = Math.min(Math.max(value, low(input)), high(input));
  });
  refresh(false);
}

function connect() {
  $("quantity").addEventListener("change", (event) => {
    view.quantity = QUANTITIES.find((q) => q.key === event.target.value);
    refreshControls();
    drawMap();
  });
  $("policy").addEventListener("change", (event) => {
    view.policy = model.policies[Number(event.target.value)];
    changed();
  });
  $("channel").addEventListener("change", (event) => {
    view.channel = Number(event.target.value);
    drawMap();
    drawProfile();
  });
  $("across").addEventListener("change", (event) => setAxis(0, Number(event.target.value)));
  $("up").addEventListener("change", (event) => setAxis(1, Number(event.target.value)));
  $("epsilon").addEventListener("input", (event) => {
    view.epsilon = Number(event.target.value);
    changed();
  });
  $("full").addEventListener("change", (event) => {
    view.full = event.target.checked;
    drawMap();
  });
  $("centre").addEventListener("click", () => {
    view.point = Float64Array.from(data.rest);
    changed();
  });
  $("random").addEventListener("click", () => {
    view.point = view.point.map((v, i) => (inputs[i].unit ? v : Math.round(100 * Math.random()) / 100));
    changed();
  });
  $("state").addEventListener("submit", (event) => event.preventDefault());
  const surface = $("surface");
  const follow = (event) => {
    const box = surface.getBoundingClientRect();
    const shares = [(event.clientX - box.left) / box.width, 1 - (event.clientY - box.top) / box.height];
    moveTo(...shares.map((share, axis) => {
      const column = Math.min(Math.max(Math.round(share * map.n - 0.5), 0), map.n - 1);
      return map.low[axis] + ((map.high[axis] - map.low[axis]) * column) / (map.n - 1);
    }));
  };
  surface.addEventListener("pointerdown", (event) => {
    surface.setPointerCapture(event.pointerId);
    follow(event);
  });
  surface.addEventListener("pointermove", (event) => { if (event.buttons) follow(event); });
  surface.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, -1], ArrowUp: [0, 1] }[event.key];
    if (!way) return;
    event.preventDefault();
    const steps = event.shiftKey ? 10 : 1;
    moveTo(...way.map((d, axis) => {
      const input = view.axes[axis], step = (high(input) - low(input)) / ((gridOf(view.policy, view.axes)?.n || N) - 1);
      return view.point[input] + d * steps * step;
    }));
  });
}

// --- panels of what does not depend on the state ---------------------------------------------------

function panel(heading, note, options, table) {
  const figure = element("figure", {});
  const id = `panel-${$("panels").childElementCount}`;
  $("panels").append(element("section", { "aria-labelledby": id },
    element("h2", { id }, heading), figure, element("p", { class: "note" }, note),
    numbers(heading, ...table)));
  const draw = () => drawLines(figure, { title: heading, ...options });
  panels.push(draw);
  draw();
}

const panels = [];

function drawPanels() {
  const { episode, training, regions, probes } = data;
  const unit = { label: "mean regret per step", low: 0, high: 1 };
  if (episode) {
    const own = episode.mean ? [{ name: data.name, x: episode.t, y: episode.mean, colour: "c0" }] : [];
    const others = Object.entries(episode.references).map(([name, y], i) => (
      { name, x: episode.t, y, colour: `c${i + 1}`, dash: DASHES[i + 1] }));
    const band = episode.mean && { name: "8 of 10 episodes", x: episode.t, low: episode.low, high: episode.high };
    const running = episode.running && episode.running[episode.running.length - 1];
    const ends = data.task.D > 0 && episode.running
      ? ` A step reward below D = ${data.task.D} ends an episode; ${fixed(100 * running, 0)} % still run in the last steps.`
      : "";
    panel("Regret over the episode",
      `Mean over ${episode.episodes} episodes from random starts.${ends}`,
      { x: { label: "step", low: 0, high: Math.max(1, data.task.T) }, y: unit, lines: [...own, ...others], band },
      [["step", ...[...own, ...others].map((line) => line.name)],
        episode.t.map((t, k) => [shortNumber(t), ...[...own, ...others].map((line) => fixed(line.y[k], 3))])]);
  }
  if (training) {
    const most = Math.max(...training.dots[0], 1);
    panel("Learning curve",
      `Exact regret of ${training.count.toLocaleString("en")} ${training.each}s of training${training.count > training.dots[0].length ? `, of which ${training.dots[0].length} are drawn` : ""}.`,
      { x: { label: "environment steps", low: 0, high: most }, y: unit,
        dots: { name: `one ${training.each}`, x: training.dots[0], y: training.dots[1] },
        lines: [{ name: `median of the last ${training.window}`, x: training.line[0], y: training.line[1], colour: "c0", width: 2.5 }] },
      [["environment steps", "median regret"],
        training.line[0].map((x, k) => [shortNumber(x), fixed(training.line[1][k], 3)])]);
  }
  if (regions) {
    const lines = Object.entries(regions.lines).map(([name, y], i) => (
      { name, x: regions.names.map((_, k) => k), y, colour: `c${i}`, dash: DASHES[i], marker: true }));
    const most = Math.max(1.05, ...lines.flatMap((line) => line.y));
    panel("Inside and outside the cube",
      "Normalised regret of the evaluation: 0 is the optimum, 1 the constant ½. WD is the cube; OOD 1, 2, … are the shells around it.",
      { x: { label: "region", low: -0.2, high: regions.names.length - 0.8, names: regions.names, ticks: regions.names.map((_, k) => k) },
        y: { label: "normalised regret", low: 0, high: most }, lines },
      [["region", ...lines.map((line) => line.name)],
        regions.names.map((name, k) => [name, ...lines.map((line) => fixed(line.y[k], 3))])]);
  }
  if (probes.length) {
    const layers = probes.map((probe) => probe.layer), names = layers.map((k) => (k ? `layer ${k}` : "seen"));
    const kinds = [["state_r2", "state", "c0", ""], ["distractor_r2", "distractors", "c1", "7 3"]]
      .filter(([field]) => probes.some((probe) => probe[field] !== null));
    const lines = kinds.map(([field, name, colour, dash]) => (
      { name, x: layers, y: probes.map((probe) => probe[field] === null ? null : Math.max(0, probe[field])), colour, dash, marker: true }));
    panel("What the layers keep",
      "Held-out R² of a linear map from a layer's outputs to the state and to the distractors: 1 recovers them, 0 is no better than their mean.",
      { x: { label: "layer", low: -0.2, high: layers.length - 0.8, names, ticks: layers }, y: { label: "R²", low: 0, high: 1 }, lines },
      [["layer", "units", ...lines.map((line) => line.name)],
        probes.map((probe, k) => [names[k], String(probe.units), ...lines.map((line) => fixed(line.y[k], 3))])]);
  }
}

function drawOrigin() {
  const { task } = data;
  $("summary").textContent = [
    `${S} state channels`, `${A} action channels`, `${task.L} ${task.L === 1 ? "layer" : "layers"} of the optimal policy`,
    ...(task.k > 1 ? [`a reward every ${task.k} steps`] : []),
    ...(task.r_min > 0 ? [`r_min = ${task.r_min}`] : []),
    ...(task.D > 0 ? [`D = ${task.D}`] : []),
    ...(task.tau ? [`limits of tightness τ = ${task.tau}`] : []),
    ...(m ? [`${m} distractors`] : []),
    ...(task.mixing !== "none" ? [`${task.mixing} mixing`] : []),
    ...(task.agents.length ? [`${task.agents.length} agents`] : []),
    `episodes of ${task.T} steps`,
  ].join(" · ");
  $("remark").hidden = !data.remark;
  $("remark").textContent = data.remark;
  const pairs = [["task", data.title], ["digest", data.digest], ...(data.name ? [["policy", data.name]] : []), ...Object.entries(data.plan)];
  $("origin").replaceChildren(...pairs.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
}

$("sliders").append(...sliders.map((each) => each.label));
connect();
drawOrigin();
drawPanels();
changed();
let resized = 0;
window.addEventListener("resize", () => {
  cancelAnimationFrame(resized);
  resized = requestAnimationFrame(() => {
    if (map) drawMarks();
    drawProfile();
    panels.forEach((draw) => draw());
  });
});

// For the console: the numbers of the map, and of any points `[rows, inputs]`.
window.explorer = {
  data,
  map: () => ({ n: map.n, axes: map.axes, low: map.low, high: map.high, point: Array.from(view.point), values: Array.from(valuesOfMap()) }),
  at: (points, policy = view.policy) => {
    const rows = points.length, flat = Float64Array.from(points.flat());
    const e = model.evaluate(flat, rows, policy);
    const regret = points.map((_, row) => model.regret(e.action, e.optimal, row));
    const plain = Object.fromEntries(Object.entries(e).map(([name, values]) => [name, Array.from(values)]));
    return { ...plain, regret };
  },
};
