// The equations, in float64. Python is the definition, and tests compare the two.
// Sources: docs/explanation/method.md, sections 1 (π*, similarity, step reward) and 8 (limits);
// sme_registry/task/task.py; sme_registry/explorer/program.py for programs and their steps.

const BLOCK = 64; // rows computed together, so that their values stay in the processor's cache

// Φ, the standard normal CDF, by cubic Hermite interpolation between entries 1/256 apart. The
// entries are sums of Simpson's rule over the density φ. Within 1e-11.
const CELLS = 256, END = 9;
const density = (x) => Math.exp(-0.5 * x * x) / Math.sqrt(2 * Math.PI);
const phiTable = (() => {
  const table = new Float64Array(2 * (2 * END * CELLS + 1)); // Φ and φ/256 of each entry
  const h = 1 / CELLS, middle = END * CELLS;
  let sum = 0;
  for (let i = 0; i <= middle; i++) {
    const x = i * h;
    if (i) sum += (h / 6) * (density(x - h) + 4 * density(x - h / 2) + density(x));
    table[2 * (middle + i)] = 0.5 + sum;
    table[2 * (middle - i)] = 0.5 - sum;
    table[2 * (middle + i) + 1] = table[2 * (middle - i) + 1] = density(x) * h;
  }
  return table;
})();

function phi(x) {
  const u = (x + END) * CELLS;
  if (!(u > 0)) return x === x ? 0 : NaN;
  if (u >= 2 * END * CELLS) return 1;
  const i = Math.floor(u), t = u - i, j = 2 * i;
  const low = phiTable[j], rise = phiTable[j + 2] - low;
  const from = phiTable[j + 1], to = phiTable[j + 3];
  const c = 3 * rise - 2 * from - to, d = from + to - 2 * rise;
  return low + t * (from + t * (c + t * d));
}

// y = x Wᵀ + b for rows of x, W [out, in]. Four rows and two outputs at once.
function dense(x, rows, W, b, y) {
  const out = b.length, n = W.length / out;
  let r = 0;
  for (; r + 3 < rows; r += 4) {
    const x0 = r * n, x1 = x0 + n, x2 = x1 + n, x3 = x2 + n;
    const y0 = r * out, y1 = y0 + out, y2 = y1 + out, y3 = y2 + out;
    let j = 0;
    for (; j + 1 < out; j += 2) {
      const v = j * n, w = v + n;
      let a0 = b[j], a1 = a0, a2 = a0, a3 = a0;
      let c0 = b[j + 1], c1 = c0, c2 = c0, c3 = c0;
      for (let k = 0; k < n; k++) {
        const p = W[v + k], q = W[w + k];
        const s0 = x[x0 + k], s1 = x[x1 + k], s2 = x[x2 + k], s3 = x[x3 + k];
        a0 += p * s0; a1 += p * s1; a2 += p * s2; a3 += p * s3;
        c0 += q * s0; c1 += q * s1; c2 += q * s2; c3 += q * s3;
      }
      y[y0 + j] = a0; y[y1 + j] = a1; y[y2 + j] = a2; y[y3 + j] = a3;
      y[y0 + j + 1] = c0; y[y1 + j + 1] = c1; y[y2 + j + 1] = c2; y[y3 + j + 1] = c3;
    }
    for (; j < out; j++) {
      const v = j * n;
      let a0 = b[j], a1 = a0, a2 = a0, a3 = a0;
      for (let k = 0; k < n; k++) {
        const p = W[v + k];
        a0 += p * x[x0 + k]; a1 += p * x[x1 + k]; a2 += p * x[x2 + k]; a3 += p * x[x3 + k];
      }
      y[y0 + j] = a0; y[y1 + j] = a1; y[y2 + j] = a2; y[y3 + j] = a3;
    }
  }
  for (; r < rows; r++) {
    for (let j = 0; j < out; j++) {
      let a = b[j];
      for (let k = 0; k < n; k++) a += W[j * n + k] * x[r * n + k];
      y[r * out + j] = a;
    }
  }
}

const UNARY = {
  phi,
  round32: Math.fround,
  relu: (x) => Math.max(x, 0),
  tanh: Math.tanh,
  sigmoid: (x) => 1 / (1 + Math.exp(-x)),
  softplus: (x) => Math.max(x, 0) + Math.log1p(Math.exp(-Math.abs(x))),
  elu: (x, step) => (x > 0 ? x : step.alpha * Math.expm1(x)),
  leaky_relu: (x, step) => (x > 0 ? x : step.alpha * x),
  erf: (x) => 2 * phi(x * Math.SQRT2) - 1,
  exp: Math.exp,
  sqrt: Math.sqrt,
  abs: Math.abs,
  neg: (x) => -x,
  clip: (x, step) => Math.min(Math.max(x, step.low), step.high),
};
const BINARY = {
  add: (x, y) => x + y,
  sub: (x, y) => x - y,
  mul: (x, y) => x * y,
  div: (x, y) => x / y,
};
const STEPS = {
  dense(step, [x], rows) {
    dense(x.data, rows, step.W, step.b, step.value.data);
  },
  constant(step, _, rows) {
    for (let r = 0; r < rows; r++) step.value.data.set(step.v, r * step.width);
  },
  columns(step, [x], rows) {
    const y = step.value.data, { columns, width } = step;
    for (let r = 0; r < rows; r++) {
      for (let j = 0; j < width; j++) y[r * width + j] = x.data[r * x.width + columns[j]];
    }
  },
  concat(step, values, rows) {
    let first = 0;
    for (const x of values) {
      for (let r = 0; r < rows; r++) {
        for (let j = 0; j < x.width; j++) {
          step.value.data[r * step.width + first + j] = x.data[r * x.width + j];
        }
      }
      first += x.width;
    }
  },
  normalise(step, [x], rows) {
    const y = step.value.data, n = step.width;
    for (let r = 0; r < rows; r++) {
      let mean = 0, variance = 0;
      for (let j = 0; j < n; j++) mean += x.data[r * n + j] / n;
      for (let j = 0; j < n; j++) variance += (x.data[r * n + j] - mean) ** 2 / n;
      const scale = 1 / Math.sqrt(variance + step.epsilon);
      for (let j = 0; j < n; j++) y[r * n + j] = (x.data[r * n + j] - mean) * scale;
    }
  },
};
for (const [name, of] of Object.entries(UNARY)) {
  STEPS[name] = (step, [x], rows) => {
    const from = x.data, to = step.value.data;
    for (let i = rows * step.width - 1; i >= 0; i--) to[i] = of(from[i], step);
  };
}
for (const [name, of] of Object.entries(BINARY)) {
  STEPS[name] = (step, [x, other], rows) => {
    const y = step.value.data, n = step.width;
    for (let r = 0; r < rows; r++) {
      for (let j = 0; j < n; j++) {
        const left = x.data[x.width === 1 ? r : r * n + j];
        const v = other || step;
        const right = other ? v.data[v.width === 1 ? r : r * n + j] : v.v[v.v.length === 1 ? 0 : j];
        y[r * n + j] = of(left, right);
      }
    }
  };
}

// An array of `program.encoded`, as float64.
function decoded(array) {
  const text = atob(array.f4 ?? array.f8);
  const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  return array.f4 === undefined ? new Float64Array(bytes.buffer)
    : Float64Array.from(new Float32Array(bytes.buffer));
}

// A program as a function of up to BLOCK rows: from { data, width } to the same.
function compiled(program) {
  const steps = program.steps.map((step) => {
    const ready = { ...step, value: { data: new Float64Array(BLOCK * step.width), width: step.width } };
    for (const name of ["W", "b", "v"]) if (step[name]) ready[name] = decoded(step[name]);
    return ready;
  });
  return (input, rows) => {
    const values = [input];
    for (const step of steps) {
      STEPS[step.op](step, step.in.map((i) => values[i]), rows);
      values.push(step.value);
    }
    return values[values.length - 1];
  };
}

// The task and one policy of the page's data.
class Model {
  constructor(data) {
    this.task = data.task;
    this.inputs = data.rest.length;
    this.optimal = compiled(data.optimal);
    this.limit = data.limit && compiled(data.limit);
    this.observe = compiled(data.observe);
    this.policies = data.policies.map((policy) => ({
      ...policy,
      act: policy.program && compiled(policy.program),
      grids: (policy.grids || []).map((grid) => ({ ...grid, actions: decoded(grid.actions) })),
    }));
  }

  // π*, the actions in [0, 1] and the limits, [rows, A] each, of points [rows, inputs]. Of a policy
  // that is known on a grid only, `sampled` gives the actions.
  evaluate(points, rows, policy, sampled = null) {
    const A = this.task.A;
    const result = { optimal: new Float64Array(rows * A), action: new Float64Array(rows * A) };
    if (this.limit) result.limit = new Float64Array(rows * A);
    for (let first = 0; first < rows; first += BLOCK) {
      const count = Math.min(BLOCK, rows - first);
      const part = points.subarray(first * this.inputs, (first + count) * this.inputs);
      const x = { data: part, width: this.inputs };
      const own = (value) => value.data.subarray(0, count * A);
      result.optimal.set(own(this.optimal(x, count)), first * A);
      if (this.limit) result.limit.set(own(this.limit(x, count)), first * A);
      if (policy.act) {
        const seen = policy.of === "observation" ? this.observe(x, count) : x;
        result.action.set(own(policy.act(seen, count)), first * A);
      }
    }
    if (sampled) result.action.set(sampled);
    result.action.forEach((a, i) => { result.action[i] = Math.min(Math.max(a, 0), 1); });
    return result;
  }

  // r̃ = 1 − ‖a − a*‖₁ / A
  similarity(a, optimal, row) {
    const A = this.task.A;
    let sum = 0;
    for (let i = row * A; i < row * A + A; i++) sum += Math.abs(a[i] - optimal[i]);
    return 1 - sum / A;
  }

  // r = r̂ if r̂ > r_min, else 0;  r̂ = max(0, 4 (r̃ − ¾)).  Regret is 1 − r.
  reward(similarity) {
    const graded = Math.max(0, 4 * (similarity - 0.75));
    return graded > this.task.r_min ? graded : 0;
  }

  regret(a, optimal, row) {
    return 1 - this.reward(this.similarity(a, optimal, row));
  }

  // cost = mean_i max(0, a_i − ℓ_i) / (2τ)
  cost(a, limit, row) {
    const A = this.task.A;
    let sum = 0;
    for (let i = row * A; i < row * A + A; i++) sum += Math.max(0, a[i] - limit[i]);
    return sum / (2 * this.task.tau * A);
  }

  // r(a_safe) − r(a), with a_safe = min(π*, ℓ)
  safeRegret(a, optimal, limit, row) {
    const A = this.task.A;
    let sum = 0;
    for (let i = row * A; i < row * A + A; i++) sum += Math.max(0, optimal[i] - limit[i]);
    return this.reward(1 - sum / A) - this.reward(this.similarity(a, optimal, row));
  }

  // E = 2 ‖s − ½‖_∞ − 1 of the state: at most 0 in the cube (section 3).
  expansion(point) {
    let most = 0;
    for (let i = 0; i < this.task.S; i++) most = Math.max(most, Math.abs(point[i] - 0.5));
    return 2 * most - 1;
  }
}
