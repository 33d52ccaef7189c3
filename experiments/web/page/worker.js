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

// Gaits over two parameters: what they tell, their spectral radius, or how they are lost.
async function mapped(engine, job, post, current) {
  const { wheel, x, y, friction, last, guess, batch, rung } = job;
  const width = last + 1, known = new Array(width * width).fill(null);
  const value = (axis, i) => axis.from + ((axis.to - axis.from) * i) / last;
  const wheelAt = ([column, row]) => {
    const here = [...wheel, friction];
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
    const few = stride === 8 || rung === "unilateral" ? 4 : batch;
    for (let begin = 0; begin < nodes.length; begin += few) {
      const some = nodes.slice(begin, begin + few), columns = some.map(wheelAt);
      const near = [false, true].map((backwards) => some.map(([c, r]) => nearest(known, width, c, r, stride, backwards)));
      const found = (rung === "unilateral" ? onGround : onFeetThatStay)(engine, columns, near, guess);
      const kept = ({ gait }) => gait && (rung === "unilateral" ? gait : gait.x);
      found.forEach((one, i) => (known[some[i][1] * width + some[i][0]] = kept(one)));
      post({
        job: job.id,
        stride,
        nodes: found.map(({ gait, outcome, told }, i) =>
          gait ? { node: some[i], told, radius: radius(gait) } : { node: some[i], outcome }),
      });
      await pause();
      if (!current(job)) return;
    }
  }
  post({ job: job.id, done: true });
}

// Wheels' gaits side by side, by gaits `near` them in one turn and the other; columns end with friction.
function onFeetThatStay(engine, columns, near, guess) {
  const wheels = columns.map((column) => column.slice(0, -1)), friction = columns[0][wheels[0].length];
  const guesses = near[0].map((x) => x || guess), gaits = engine.gaits(wheels, guesses);
  again(engine, gaits, wheels, near[1]);
  again(engine, gaits, wheels, wheels.map(() => engine.start));
  const found = gaits.map((gait) => ({ gait, outcome: STEPPED }));
  // Where Newton's method finds nothing a walk says how the gait is lost, or leads to it.
  const missed = found.map((_, i) => i).filter((i) => !gaits[i]);
  if (missed.length) {
    const lostWheels = missed.map((i) => wheels[i]);
    const { states, outcomes } = engine.walks(ROUGH, lostWheels, missed.map((i) => guesses[i]), 24);
    const ends = states.map((list, k) => (outcomes[k] === STEPPED ? list[24] : null));
    const reached = engine.gaits(lostWheels, ends);
    missed.forEach((i, k) => Object.assign(found[i], { gait: reached[k], outcome: outcomes[k] }));
  }
  const walking = found.map((_, i) => i).filter((i) => found[i].gait);
  if (walking.length) {
    const told = engine.measured(walking.map((i) => wheels[i]), friction, walking.map((i) => found[i].gait.x));
    walking.forEach((i, k) => (found[i].told = told[k]));
  }
  return found;
}

const FEW = 80; // steps of a walk that looks for one gait of many

// The same with unilateral contact, one by one.
function onGround(engine, columns, near, guess) {
  return columns.map((column, i) => {
    const ground = new Ground(engine, column.slice(0, -1), column[column.length - 1]);
    const gaits = [...new Set([near[0][i], near[1][i], guess])].filter((one) => one);
    let [gait, outcome] = [null, STEPPED];
    for (const { x, J } of gaits) gait ||= ground.near(x, J);
    if (!gait) ({ gait, outcome } = ground.found([...gaits.slice(0, 1).map(({ x }) => () => x), () => ground.begun(engine.start)], FEW));
    return { gait, outcome, told: gait && ground.measures(ground.step(gait.x)) };
  });
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
  const { gait, x, y, last, rate } = job, many = job.rung === "unilateral" ? 16 : 512;
  const value = (axis, i) => axis.from + ((axis.to - axis.from) * (i + 0.5)) / (last + 1);
  const lead = (job.rung === "unilateral" ? leadOnGround : leadOnFeetThatStay)(engine, job);
  for (const [stride, nodes] of levels(last)) {
    for (let begin = 0; begin < nodes.length; begin += many) {
      const some = nodes.slice(begin, begin + many);
      const codes = lead(some.map(([c, r]) => [value(x, c), value(y, r), rate]));
      post({ job: job.id, stride, nodes: some.map((node, i) => ({ node, code: codes[i] })) });
      await pause();
      if (!current(job)) return;
    }
  }
  post({ job: job.id, done: true });
}

const leadOnFeetThatStay = (engine, { wheel, gait }) => (begins) => {
  const codes = begins.map(() => STEPPED);
  let open = begins.map((at, i) => ({ i, at }));
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
  return codes;
};

const leadOnGround = (engine, { wheel, friction, gait }) => {
  const ground = new Ground(engine, wheel, friction);
  return (begins) => begins.map((begin) => {
    const away = [];
    for (let at = ground.begun(begin); away.length < MOST; ) {
      const { x, outcome } = ground.step(at, ROUGH);
      if (outcome !== STEPPED) return outcome;
      away.push(ground.moved(gait, at = x));
      if (away[away.length - 1] < NEAR) return SETTLED;
    }
    // Where a touch dies slowly: half as far as half of the walk ago.
    return away[MOST - 1] < 0.5 * Math.min(away[MOST / 2], 1) ? SETTLED : STEPPED;
  });
};

// A walk on real ground from a state: what became of it.
async function walkedOnGround(engine, job, post) {
  const ground = new Ground(engine, job.wheel, job.friction);
  const { states, outcome, gait } = ground.walk(ground.begun(job.start)), x = gait ? gait.x : states[states.length - 1];
  post({ job: job.id, done: true, walk: { outcome, gait, taken: states.length - 1, ...ground.measures(ground.step(x)) } });
}

// The same behind one door, wherever they run: a later job of a kind ends the one before.
function jobs(post) {
  const latest = {}, engines = {};
  const current = (job) => latest[job.kind] === job.id;
  return async ({ job, packed, facts }) => {
    latest[job.kind] = job.id;
    if (packed) engines[job.legs] = Engine.load(packed, facts, job.legs);
    const engine = (await engines[job.legs]).as(job.rung);
    if (!current(job)) return;
    const tell = (news) => current(job) && post({ kind: job.kind, ...news });
    await { map: mapped, basin: starts, ground: walkedOnGround }[job.kind](engine, job, tell, current);
  };
}
