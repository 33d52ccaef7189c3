"use strict";
// Maps and basins, computed beside the page and refined as they go. `post` tells what is new.

const pause = () => new Promise((go) => setTimeout(go));

// Every node of a square grid once, coarse ones first: lists of [column, row] by stride.
function* levels(last) {
  for (let stride = 8; stride >= 1; stride /= 2) {
    const nodes = [];
    for (let row = 0; row <= last; row += stride)
      for (let column = 0; column <= last; column += stride)
        if (stride === 8 || row % (2 * stride) || column % (2 * stride)) nodes.push([column, row]);
    yield [stride, nodes];
  }
}

// Gaits over two parameters: rows of what they tell, their spectral radius, or how they are lost.
async function mapped(engine, job, post, current) {
  const { wheel, x, y, friction, last, guess, batch } = job;
  const width = last + 1, known = new Array(width * width).fill(null);
  const value = (axis, i) => axis.from + ((axis.to - axis.from) * i) / last;
  const wheelAt = (column, row) => {
    const here = [...wheel];
    here[x.index] = value(x, column);
    here[y.index] = value(y, row);
    return here;
  };
  for (const [stride, nodes] of levels(last)) {
    // The coarse grid grows from the dot, later ones from the nodes beside them.
    if (stride === 8) {
      const far = ([c, r]) => Math.hypot(c - job.dot[0], r - job.dot[1]);
      nodes.sort((a, b) => far(a) - far(b));
    }
    const size = stride === 8 ? 4 : batch;
    for (let begin = 0; begin < nodes.length; begin += size) {
      const some = nodes.slice(begin, begin + size), wheels = some.map(([c, r]) => wheelAt(c, r));
      const guesses = some.map(([c, r]) => nearest(known, width, c, r, stride) || guess);
      const gaits = engine.gaits(wheels, guesses);
      again(engine, gaits, wheels, some.map(([c, r]) => nearest(known, width, c, r, stride, true)));
      again(engine, gaits, wheels, some.map(() => engine.start));
      const found = gaits.map((gait, i) => ({ gait, outcome: STEPPED, node: some[i] }));
      // Where Newton's method finds nothing a walk says how the gait is lost, or leads to it.
      const missed = found.map((_, i) => i).filter((i) => !gaits[i]);
      if (missed.length) {
        const lostWheels = missed.map((i) => wheels[i]);
        const starts = missed.map((i) => guesses[i]);
        const { states, outcomes } = engine.walks(ROUGH, lostWheels, starts, 24);
        const ends = states.map((list, k) => (outcomes[k] === STEPPED ? list[24] : null));
        const reached = engine.gaits(lostWheels, ends);
        missed.forEach((i, k) => {
          found[i].gait = reached[k];
          found[i].outcome = outcomes[k];
        });
      }
      const walking = found.filter(({ gait }) => gait);
      if (walking.length) {
        const told = engine.measured(
          walking.map(({ node }) => wheelAt(...node)), friction, walking.map(({ gait }) => gait.x),
        );
        walking.forEach((one, i) => (one.told = told[i]));
      }
      for (const { gait, node: [c, r] } of found) known[r * width + c] = gait && gait.x;
      post({
        job: job.id,
        stride,
        nodes: found.map(({ gait, outcome, node, told }) =>
          gait ? { node, told, radius: radius(gait) } : { node, outcome }),
      });
      await pause();
      if (!current(job)) return;
    }
  }
  post({ job: job.id, done: true });
}

// Newton's method once more where it found nothing, from other guesses.
function again(engine, gaits, wheels, guesses) {
  const missed = gaits.map((_, i) => i).filter((i) => !gaits[i] && guesses[i]);
  if (!missed.length) return;
  const found = engine.gaits(missed.map((i) => wheels[i]), missed.map((i) => guesses[i]));
  missed.forEach((i, k) => (gaits[i] = found[k]));
}

const AROUND = [[-1, 0], [1, 0], [0, -1], [0, 1], [-1, -1], [1, 1], [-1, 1], [1, -1]];

// The gait of a known node beside this one, looked for around it in one turn or the other.
function nearest(known, width, column, row, stride, backwards) {
  for (let ring = 1; ring <= 2; ring++)
    for (const [dc, dr] of backwards ? [...AROUND].reverse() : AROUND) {
      const c = column + dc * ring * stride, r = row + dr * ring * stride;
      if (c < 0 || r < 0 || c >= width || r >= width) continue;
      if (known[r * width + c]) return known[r * width + c];
    }
  return null;
}

const NEAR = 0.02, MOST = 40; // a start is home so near to a stable gait, and lost after so many steps
const SETTLED = -1;

// Where starts lead: to the gait, or to which end. Codes by node.
async function starts(engine, job, post, current) {
  const { wheel, gait, x, y, last } = job;
  const value = (axis, i) => axis.from + ((axis.to - axis.from) * (i + 0.5)) / (last + 1);
  for (const [stride, nodes] of levels(last)) {
    for (let begin = 0; begin < nodes.length; begin += 512) {
      const some = nodes.slice(begin, begin + 512), codes = some.map(() => STEPPED);
      let open = some.map(([c, r], i) => ({ i, at: [value(x, c), value(y, r), gait[2]] }));
      for (let step = 0; step < MOST && open.length; step++) {
        const taken = engine.linearised(ROUGH, open.map(() => wheel), open.map(({ at }) => at));
        open = open.filter((one, k) => {
          codes[one.i] = taken[k].outcome;
          one.at = taken[k].x;
          if (taken[k].outcome !== STEPPED) return false;
          const away = Math.max(...one.at.map((v, j) => Math.abs(v - gait[j])));
          if (away < NEAR) codes[one.i] = SETTLED;
          return away >= NEAR;
        });
      }
      post({ job: job.id, stride, nodes: some.map((node, i) => ({ node, code: codes[i] })) });
      await pause();
      if (!current(job)) return;
    }
  }
  post({ job: job.id, done: true });
}

const GROUND_STEPS = 80, REPEATS = 1e-8;

// A walk on real ground from a state: what became of it.
async function walkedOnGround(engine, job, post, current) {
  const { wheel, friction } = job;
  let state = engine.begunOnGround(wheel, job.start);
  for (let taken = 0; taken < GROUND_STEPS; taken++) {
    const { x, durations, step_length, outcome } = engine.steppedOnGround(wheel, friction, state);
    const away = Math.max(...x.map((value, i) => Math.abs(value - state[i]))), settled = outcome === STEPPED && away < REPEATS;
    const period = durations.reduce((a, b) => a + b), ends = outcome !== STEPPED || settled || taken === GROUND_STEPS - 1;
    if (ends) return post({ job: job.id, done: true, walk: { x, outcome, settled, taken, period, speed: step_length / period, dls_fraction: durations[0] / period } });
    state = x;
    await pause();
    if (!current(job)) return;
  }
}

// The same behind one door, wherever they run: a later job of a kind ends the one before.
function jobs(post) {
  const latest = {}, engines = {};
  const current = (job) => latest[job.kind] === job.id;
  return async ({ job, packed, facts }) => {
    latest[job.kind] = job.id;
    if (packed) engines[job.legs] = Engine.load(packed, facts, job.legs);
    const engine = (await engines[job.legs]).as(job.kind === "ground" ? "ground" : job.rung);
    if (!current(job)) return;
    const tell = (news) => current(job) && post({ kind: job.kind, ...news });
    await { map: mapped, basin: starts, ground: walkedOnGround }[job.kind](engine, job, tell, current);
  };
}
