"use strict";
// The library's step in WebAssembly, and what is searched with it. Runs in the page and its worker.

const SHOWN = 1e-10, SOUGHT = 5e-12, ROUGH = 1e-6; // tolerances of the integrator
const FOUND = 1e-8; // a gait that moves less in a step is one correction away
const LIMITS = [0.15, 0.6, 0.6]; // of a correction: rad, rad/s, m/s
const STEPPED = 0;

class Engine {
  // `packed`: the codes, that of any number of legs and that of so many, gzipped, by `unpacked`.
  static async load(packed, facts, legs) {
    const codes = packed.map(async (text) => {
      const stream = new Blob([unpacked(text)]).stream().pipeThrough(new DecompressionStream("gzip"));
      const code = await new Response(stream).arrayBuffer();
      return (await WebAssembly.instantiate(code, { env: Math })).instance.exports;
    });
    return new Engine(await Promise.all(codes), facts, legs);
  }

  constructor(codes, facts, legs, rung = "viscoelastic") {
    Object.assign(this, { codes, facts, legs, rung });
    this.prefix = { viscoelastic: "", rigid: "rigid_", unilateral: "ground_" }[rung];
    this.alpha = (2 * Math.PI) / legs;
    this.samples = facts.samples;
    this.rows = facts.rows[legs];
    this.start = facts.start;
    // Of each phase the motion: thirteen rows, with rigid legs one phase and its times.
    this.motion = rung === "rigid" ? [14] : [13, 13, 13];
  }

  // The same code for another rung.
  as(rung) {
    return new Engine(this.codes, this.facts, this.legs, rung);
  }

  // Numbers; arrays as lists of columns, one for each lane, or as results; these as [rows, is it of
  // floats]. They lie row after row, `lanes` numbers each, until the next call.
  run(name, numbers, columns, told) {
    const n = columns[0].length, lanes = n + (n % 2), called = this.prefix + name;
    const code = this.codes.find((one) => one[called]);
    let end = Math.ceil(code.__heap_base.value / 16) * 16;
    const place = (bytes) => {
      const here = end;
      end += Math.ceil(bytes / 16) * 16;
      return here;
    };
    const single = numbers.map(() => place(8));
    const arrays = columns.map((some) => place(8 * (some[0].length * lanes || some.length)));
    const results = told.map(([rows, floats]) => place((floats ? 8 : 4) * rows * lanes));
    const given = place(4 * (single.length + arrays.length)), out = place(4 * results.length);
    const memory = code.memory, missing = end - memory.buffer.byteLength;
    if (missing > 0) memory.grow(Math.ceil(missing / 65536));
    const pointers = new Int32Array(memory.buffer), floats = new Float64Array(memory.buffer);
    numbers.forEach((x, i) => (floats[single[i] / 8] = x));
    columns.forEach((some, i) => {
      if (some instanceof Float64Array) return floats.set(some, arrays[i] / 8);
      for (let lane = 0; lane < lanes; lane++) {
        const column = some[Math.min(lane, n - 1)];
        for (let row = 0; row < column.length; row++)
          floats[arrays[i] / 8 + row * lanes + lane] = column[row];
      }
    });
    [...single, ...arrays].forEach((where, i) => (pointers[given / 4 + i] = where));
    results.forEach((where, i) => (pointers[out / 4 + i] = where));
    code[called](given, out, BigInt(lanes), 0n, BigInt(lanes / 2));
    return told.map(([rows, isFloat], i) => {
      const kind = isFloat ? Float64Array : Int32Array;
      return new kind(memory.buffer, results[i], rows * lanes);
    });
  }

  // One step of each lane: section states, outcomes and the Jacobian of the state by itself.
  linearised(tolerance, wheels, starts) {
    const n = wheels.length, lanes = n + (n % 2), told = [[6, true], [2], [18, true]];
    const given = this.rung === "rigid" ? [tolerance] : [tolerance, this.legs];
    const [numbers, codes, columns] = this.run("linearised", given, [wheels, starts], told);
    return starts.map((_, i) => ({
      x: [0, 1, 2].map((row) => numbers[row * lanes + i]),
      outcome: codes[i],
      J: [0, 1, 2].map((row) => [0, 1, 2].map((k) => columns[(6 * k + row) * lanes + i])),
    }));
  }

  // Everything about a step: measures by name, and the motion of each phase, 13 rows of samples.
  told(wheel, friction, x) {
    const [numbers, codes, ...phases] = this.allTold([wheel], friction, [x]);
    const measures = {};
    this.rows.forEach((name, i) => (measures[name] = numbers[2 * i]));
    const own = (all) => Float64Array.from({ length: all.length / 2 }, (_, i) => all[2 * i]);
    const period = measures.duration_dls + measures.duration_sls1 + measures.duration_sls2;
    measures.period = period;
    measures.speed = period > 0 ? measures.step_length / period : 0;
    measures.dls_fraction = period > 0 ? measures.duration_dls / period : 0;
    return { measures, outcome: codes[0], motion: phases.map(own) };
  }

  allTold(wheels, friction, starts) {
    const motion = this.motion.map((rows) => [rows * this.samples, true]);
    const results = [[this.rows.length, true], [2], ...motion];
    return this.run("told", [SHOWN, friction], [wheels, starts], results);
  }

  // The same measures of many wheels.
  measured(wheels, friction, starts) {
    const n = wheels.length, lanes = n + (n % 2);
    const [numbers] = this.allTold(wheels, friction, starts);
    return starts.map((_, i) => this.rows.map((_, row) => numbers[row * lanes + i]));
  }

  // Newton's method on step(x) - x, all lanes at once; null where it finds nothing.
  gaits(wheels, guesses) {
    const found = wheels.map(() => null), tries = wheels.map(() => 0);
    const at = guesses.map((x) => x && [...x]), before = guesses.map(() => null);
    let open = wheels.map((_, i) => i).filter((i) => guesses[i]);
    for (let turn = 0; turn < 16 && open.length; turn++) {
      const steps = this.linearised(SOUGHT, open.map((i) => wheels[i]), open.map((i) => at[i]));
      open = open.filter((i, k) => {
        const { x, J, outcome } = steps[k], here = at[i];
        if (outcome !== STEPPED) {
          // Half of the way back, if a correction led here.
          if (!before[i] || ++tries[i] > 5) return false;
          at[i] = here.map((value, j) => 0.5 * (value + before[i][j]));
          return true;
        }
        const rest = x.map((value, j) => value - here[j]);
        const move = solved(J, rest);
        if (!move) return false;
        const longest = Math.max(...move.map((value, j) => Math.abs(value) / LIMITS[j]));
        const share = Math.min(1, 1 / longest);
        before[i] = here;
        at[i] = here.map((value, j) => value + share * move[j]);
        if (Math.max(...rest.map(Math.abs)) > FOUND) return at[i][1] > 0;
        found[i] = { x: at[i], J, multipliers: multipliers(J) };
        return false;
      });
    }
    return found;
  }

  // Steps of each lane until it is lost or has taken so many; states[i] lists those of lane i.
  walks(tolerance, wheels, starts, most) {
    const states = starts.map((x) => [x]), outcomes = starts.map(() => STEPPED);
    let open = starts.map((_, i) => i);
    for (let step = 0; step < most && open.length; step++) {
      const last = open.map((i) => states[i][states[i].length - 1]);
      const steps = this.linearised(tolerance, open.map((i) => wheels[i]), last);
      open = open.filter((i, k) => {
        outcomes[i] = steps[k].outcome;
        if (steps[k].outcome === STEPPED) states[i].push(steps[k].x);
        return steps[k].outcome === STEPPED;
      });
    }
    return { states, outcomes };
  }

  // A wheel's gait, from guesses, else from where walks from many starts lead; null if none is found.
  gait(wheel, guesses) {
    let unstable = null;
    for (const guess of guesses) {
      const [found] = this.gaits([wheel], [guess]);
      if (found && isStable(found)) return found;
      unstable ||= found;
    }
    const starts = [];
    for (const theta of [0.1, 0.25, 0.5, 0.75])
      for (const rate of [0.7, 1.1, 1.6, 2.2, 3.0]) starts.push([theta * this.alpha, rate, -0.1]);
    const { states, outcomes } = this.walks(ROUGH, starts.map(() => wheel), starts, 30);
    const ends = states.filter((_, i) => outcomes[i] === STEPPED).map((list) => list[30]);
    const alike = (a, b) => a.every((value, j) => Math.abs(value - b[j]) < 1e-2);
    const apart = ends.filter((end, i) => ends.findIndex((other) => alike(end, other)) === i).slice(0, 4);
    const all = this.gaits(apart.map(() => wheel), apart).filter((found) => found);
    return all.find(isStable) || unstable || all[0] || null;
  }
}

// Bytes of base 85, where "." is "<", less as many as the first digit says.
function unpacked(text) {
  const digits = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%&()*+-;.=>?@^_`{|}~";
  const value = new Map([...digits].map((digit, i) => [digit, i]));
  const view = new DataView(new ArrayBuffer(((text.length - 1) / 5) * 4));
  for (let i = 1; i < text.length; i += 5) {
    let word = 0;
    for (let k = i; k < i + 5; k++) word = word * 85 + value.get(text[k]);
    view.setUint32(((i - 1) / 5) * 4, word);
  }
  return view.buffer.slice(0, view.byteLength - text[0]);
}

const size = ({ re, im }) => Math.hypot(re, im);
const radius = (gait) => Math.max(0, ...gait.multipliers.map(size));
const isStable = (gait) => radius(gait) < 1;
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);

// (1 - J)^-1 r; null where it has none.
function solved(J, r) {
  const n = r.length, rows = J.map((row, i) => [...row.map((value, k) => (i === k ? 1 : 0) - value), r[i]]);
  for (let k = 0; k < n; k++) {
    let best = k;
    for (let i = k + 1; i < n; i++) if (Math.abs(rows[i][k]) > Math.abs(rows[best][k])) best = i;
    [rows[k], rows[best]] = [rows[best], rows[k]];
    if (!(Math.abs(rows[k][k]) > 1e-14)) return null;
    for (let i = 0; i < n; i++) {
      if (i === k) continue;
      const factor = rows[i][k] / rows[k][k];
      for (let j = k; j <= n; j++) rows[i][j] -= factor * rows[k][j];
    }
  }
  return rows.map((row, i) => row[n] / row[i]);
}

// Eigenvalues that are not 0, the largest first; `noise`: what of a column's size is rounding.
function multipliers(J, noise = 1e-13) {
  // Where J leads to, as orthonormal columns: within it lies all that is not forgotten.
  const length = (column) => Math.sqrt(dot(column, column)), Q = [];
  let rest = J.map((_, k) => J.map((row) => row[k]));
  const most = Math.max(...rest.map(length));
  while (Q.length < J.length) {
    const lengths = rest.map(length), longest = Math.max(...lengths);
    if (!(longest > noise * most)) break;
    const q = rest[lengths.indexOf(longest)].map((value) => value / longest);
    Q.push(q);
    rest = rest.map((column) => {
      const along = dot(q, column);
      return column.map((value, i) => value - along * q[i]);
    });
  }
  const M = Q.map((q) => Q.map((p) => dot(q, J.map((row) => dot(row, p)))));
  return roots(characteristic(M)).sort((a, b) => size(b) - size(a));
}

// Coefficients after the leading 1 of a matrix's characteristic polynomial, by Faddeev and LeVerrier.
function characteristic(M) {
  let N = M.map((row) => row.map(() => 0)), last = 1;
  return M.map((_, k) => {
    const before = N.map((row, i) => row.map((value, j) => value + (i === j ? last : 0)));
    N = M.map((row) => M.map((_, j) => row.reduce((sum, value, l) => sum + value * before[l][j], 0)));
    last = -N.reduce((sum, row, i) => sum + row[i], 0) / (k + 1);
    return last;
  });
}

// Roots of a polynomial of real coefficients, all at once, by Weierstrass.
function roots(coefficients) {
  const times = (a, b) => ({ re: a.re * b.re - a.im * b.im, im: a.re * b.im + a.im * b.re });
  const less = (a, b) => ({ re: a.re - b.re, im: a.im - b.im });
  const over = (a, b) => {
    const whole = b.re * b.re + b.im * b.im;
    return { re: (a.re * b.re + a.im * b.im) / whole, im: (a.im * b.re - a.re * b.im) / whole };
  };
  const scale = Math.max(...coefficients.map((value, i) => Math.abs(value) ** (1 / (i + 1))), 0);
  const found = coefficients.map((_, i) => ({ re: scale * Math.cos(2.4 * i + 0.4), im: scale * Math.sin(2.4 * i + 0.4) }));
  for (let turn = 0; turn < 300; turn++) {
    let moved = 0;
    found.forEach((z, i) => {
      let value = { re: 1, im: 0 }, apart = { re: 1, im: 0 };
      for (const c of coefficients) (value = times(value, z)).re += c;
      found.forEach((other, k) => k !== i && (apart = times(apart, less(z, other))));
      const step = over(value, apart);
      if (!isFinite(step.re + step.im)) return;
      found[i] = less(z, step);
      moved = Math.max(moved, size(step));
    });
    if (!(moved > 1e-16 * scale)) break;
  }
  return found.map(({ re, im }) => ({ re, im: Math.abs(im) > 1e-9 * scale ? im : 0 }));
}
