"use strict";
// The library's step in WebAssembly, and what is searched with it. Runs in the page and its worker.

const SHOWN = 1e-10, SOUGHT = 5e-12, ROUGH = 1e-6; // tolerances of the integrator
const FOUND = 1e-8; // a gait that moves less in a step is one correction away
const LIMITS = [0.15, 0.6, 0.6]; // of a correction: rad, rad/s, m/s
const STEPPED = 0;

class Engine {
  // `packed`: the code, gzipped, by `unpacked`.
  static async load(packed, facts, legs) {
    const stream = new Blob([unpacked(packed)]).stream().pipeThrough(new DecompressionStream("gzip"));
    const code = await new Response(stream).arrayBuffer();
    const { instance } = await WebAssembly.instantiate(code, { env: Math });
    return new Engine(instance.exports, facts, legs);
  }

  constructor(code, facts, legs, rung = "viscoelastic") {
    Object.assign(this, { code, facts, legs, rung });
    this.prefix = rung === "viscoelastic" ? "" : `${rung}_`;
    this.alpha = (2 * Math.PI) / legs;
    this.samples = facts.samples;
    this.rows = facts.rows[legs];
    this.start = facts.start;
    this.free = Math.ceil(code.__heap_base.value / 16) * 16;
    // Of each phase the motion: thirteen rows, with rigid legs one phase and its times.
    this.motion = rung === "rigid" ? [14] : [13, 13, 13];
  }

  // The same code for another rung.
  as(rung) {
    return new Engine(this.code, this.facts, this.legs, rung);
  }

  // Numbers; arrays as lists of columns, one for each lane; results as [rows, is it of floats].
  // Results lie row after row, `lanes` numbers each.
  run(name, numbers, columns, told) {
    const n = columns[0].length, lanes = n + (n % 2);
    let end = this.free;
    const place = (bytes) => {
      const here = end;
      end += Math.ceil(bytes / 16) * 16;
      return here;
    };
    const single = numbers.map(() => place(8));
    const arrays = columns.map((some) => place(8 * some[0].length * lanes));
    const results = told.map(([rows, floats]) => place((floats ? 8 : 4) * rows * lanes));
    const given = place(4 * (single.length + arrays.length)), out = place(4 * results.length);
    const memory = this.code.memory, missing = end - memory.buffer.byteLength;
    if (missing > 0) memory.grow(Math.ceil(missing / 65536));
    const pointers = new Int32Array(memory.buffer), floats = new Float64Array(memory.buffer);
    numbers.forEach((x, i) => (floats[single[i] / 8] = x));
    columns.forEach((some, i) => {
      for (let lane = 0; lane < lanes; lane++) {
        const column = some[Math.min(lane, n - 1)];
        for (let row = 0; row < column.length; row++)
          floats[arrays[i] / 8 + row * lanes + lane] = column[row];
      }
    });
    [...single, ...arrays].forEach((where, i) => (pointers[given / 4 + i] = where));
    results.forEach((where, i) => (pointers[out / 4 + i] = where));
    this.code[this.prefix + name](given, out, BigInt(lanes), 0n, BigInt(lanes / 2));
    return told.map(([rows, isFloat], i) => {
      const kind = isFloat ? Float64Array : Int32Array;
      return new kind(memory.buffer, results[i], rows * lanes);
    });
  }

  // The section state of real ground that a state of the paper's is, and one step from there.
  begunOnGround(wheel, x) {
    const size = 4 + 3 * this.legs, [state] = this.run("begun", [], [[wheel], [x]], [[size, true]]);
    return Array.from({ length: size }, (_, i) => state[2 * i]);
  }

  steppedOnGround(wheel, friction, x) {
    const told = [[x.length + 4, true], [2]];
    const [numbers, codes] = this.run("advance", [SHOWN, friction], [[wheel], [x]], told);
    const own = Array.from({ length: x.length + 4 }, (_, i) => numbers[2 * i]);
    const durations = own.slice(x.length, -1), step_length = own[own.length - 1];
    return { x: own.slice(0, x.length), durations, step_length, outcome: codes[0] };
  }

  // One step of each lane: section states, outcomes and the Jacobian of the state by itself.
  linearised(tolerance, wheels, starts) {
    const n = wheels.length, lanes = n + (n % 2), told = [[6, true], [2], [18, true]];
    const [numbers, codes, columns] = this.run("linearised", [tolerance], [wheels, starts], told);
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

const radius = (gait) => Math.hypot(gait.multipliers[0].re, gait.multipliers[0].im);
const isStable = (gait) => radius(gait) < 1;

// (1 - J)^-1 r of three numbers; null where it has none.
function solved(J, r) {
  const rows = J.map((row, i) => [...row.map((value, k) => (i === k ? 1 : 0) - value), r[i]]);
  for (let k = 0; k < 3; k++) {
    let best = k;
    for (let i = k + 1; i < 3; i++) if (Math.abs(rows[i][k]) > Math.abs(rows[best][k])) best = i;
    [rows[k], rows[best]] = [rows[best], rows[k]];
    if (!(Math.abs(rows[k][k]) > 1e-14)) return null;
    for (let i = 0; i < 3; i++) {
      if (i === k) continue;
      const factor = rows[i][k] / rows[k][k];
      for (let j = k; j < 4; j++) rows[i][j] -= factor * rows[k][j];
    }
  }
  return rows.map((row, i) => row[3] / row[i]);
}

// Eigenvalues of three by three, the largest first: roots of z³ - t z² + s z - d.
function multipliers(J) {
  const minor = (i, k) => J[i][i] * J[k][k] - J[i][k] * J[k][i];
  const t = J[0][0] + J[1][1] + J[2][2], s = minor(0, 1) + minor(0, 2) + minor(1, 2);
  const d =
    J[0][0] * minor(1, 2) -
    J[0][1] * (J[1][0] * J[2][2] - J[1][2] * J[2][0]) +
    J[0][2] * (J[1][0] * J[2][1] - J[1][1] * J[2][0]);
  // A real root: the outermost one, towards which Newton's method goes without turning back.
  const bend = t / 3, at = (z) => ((z - t) * z + s) * z - d;
  const bound = 1 + Math.max(Math.abs(t), Math.abs(s), Math.abs(d));
  let z = at(bend) > 0 ? -bound : bound;
  for (let i = 0; i < 200; i++) {
    const next = z - at(z) / ((3 * z - 2 * t) * z + s);
    if (!(Math.abs(next - z) > 1e-17 * bound)) break;
    z = next;
  }
  // The others: z² + p z + q, by dividing from the end that keeps digits.
  const p = z - t, q = Math.abs(z) > 1e-3 ? d / z : s + z * p;
  const inside = (p * p) / 4 - q;
  let pair;
  if (inside >= 0) {
    const far = -p / 2 - Math.sign(p || 1) * Math.sqrt(inside);
    pair = [{ re: far, im: 0 }, { re: far === 0 ? 0 : q / far, im: 0 }];
  } else {
    const im = Math.sqrt(-inside);
    pair = [{ re: -p / 2, im }, { re: -p / 2, im: -im }];
  }
  const size = (m) => Math.hypot(m.re, m.im);
  return [{ re: z, im: 0 }, ...pair].sort((a, b) => size(b) - size(a));
}
