// Walks on real ground: from event to event, to where steps repeat themselves, and what a touch does.

const UNDER_WAY = -1, ON_STOPPER = 4; // in place of an outcome; what of a leg's code is its stopper
const GROUND_STEPS = 160, TURNS = 9; // of a walk to where it repeats itself, and of Newton's method
const LOOKS = [0, 3, 9, 19, 29, 44, 69, 109, 159]; // steps after which a walk looks whether a gait is near
const NEARBY = 0.3, CLOSE = 1e-4, REPEATS = 1e-9, TOUCH = 2e-5; // of a section state: m, rad, s
const LOOSE = 1e-7, DIFFERED = 1e-8; // tolerances of walks that look for one, and of differences
const FELT = 1e-5; // of a column of differences over what is touched: less is their own error

class Ground {
  constructor(engine, wheel, friction) {
    Object.assign(this, { engine: engine.as("unilateral"), wheel, friction, legs: engine.legs });
    Object.assign(this, engine.facts.ground[engine.legs]);
    this.names = engine.facts.groundTold;
  }

  // The section state that a state of the paper's is.
  begun(x) {
    const [state] = this.engine.run("begun", [], [[this.wheel], [x]], [[this.section, true]]);
    return this.column(state, 0);
  }

  column(rows, lane) {
    return Array.from({ length: rows.length / 2 }, (_, i) => rows[2 * i + lane]);
  }

  // Steps from a state, or from two side by side: where each ends, what it tells, its stretches.
  steps(tolerance, starts) {
    const given = [tolerance, this.friction], wheels = starts.map(() => this.wheel), stretches = starts.map(() => []);
    const form = [[this.lane, true], [7 + 4 * this.legs, true], [this.section + this.names.length, true], [1]];
    let [lane] = this.engine.run("opened", given, [wheels, starts], [[this.lane, true]]);
    for (;;) {
      const [now, stretch, told, outcomes] = this.engine.run("onward", given, [wheels, lane.slice()], form);
      starts.forEach((_, i) => outcomes[i] === UNDER_WAY && stretches[i].push(this.column(stretch, i)));
      lane = now;
      if (outcomes.includes(UNDER_WAY)) continue;
      return starts.map((_, i) => {
        const own = this.column(told, i);
        return { x: own.slice(0, this.section), told: own.slice(this.section), outcome: outcomes[i], stretches: stretches[i] };
      });
    }
  }

  step(x, tolerance = SHOWN) {
    return this.steps(tolerance, [x])[0];
  }

  // Measures of a step by name.
  measures({ told, x }) {
    const measures = Object.fromEntries(this.names.map((name, i) => [name, told[i]]));
    const period = measures.duration_dls + measures.duration_single + measures.duration_flight;
    const share = (value) => (period > 0 ? value / period : 0);
    return {
      ...measures, period, speed: share(measures.step_length), dls_fraction: share(measures.duration_dls),
      theta_touchdown: x[0], dtheta_touchdown: x[1],
    };
  }

  // Numbers of a section state that its step feels: a loaded leg's length is the ground's.
  felt(x) {
    const n = this.legs, found = [0, 1, 2, 3];
    for (let leg = 0; leg < n; leg++) {
      const code = x[4 + 2 * n + leg];
      if (code >= ON_STOPPER) continue;
      if (code === 0) found.push(4 + leg);
      found.push(4 + n + leg);
    }
    return found;
  }

  // How far a state has moved in a step; without end where legs stand otherwise.
  moved(x, image) {
    return x.some((code, i) => i >= 4 + 2 * this.legs && code !== image[i]) ? Infinity
      : Math.max(...this.felt(x).map((i) => Math.abs(image[i] - x[i])));
  }

  // The step's Jacobian among what it feels, by differences to both sides; null where they differ in kind.
  jacobian(x, tolerance) {
    const felt = this.felt(x), columns = [];
    for (const i of felt) {
      const pair = [TOUCH, -TOUCH].map((by) => x.map((value, k) => (k === i ? value + by : value)));
      const [up, down] = this.steps(tolerance, pair);
      if (up.outcome !== STEPPED || down.outcome !== STEPPED || this.moved(up.x, down.x) === Infinity) return null;
      columns.push(felt.map((k) => (up.x[k] - down.x[k]) / (2 * TOUCH)));
    }
    return felt.map((_, row) => columns.map((column) => column[row]));
  }

  // The gait near a state, by Newton's method, whose Jacobian, that of a gait beside if it is known, learns
  // from its steps (Broyden); null without.
  near(x, known) {
    let J = known, at = x, before = Infinity, last = null;
    for (let turn = 0; turn < TURNS; turn++) {
      const { x: image, outcome } = this.step(at, before < CLOSE ? SOUGHT : LOOSE), felt = this.felt(at);
      const away = outcome === STEPPED ? this.moved(at, image) : Infinity;
      if (before < CLOSE && away < REPEATS) {
        J = this.jacobian(image, DIFFERED);
        return J && { x: image, J, multipliers: multipliers(J, FELT) };
      }
      if (!(away < 0.5 * before) && away > CLOSE) return null;
      if (J?.length !== felt.length || !(away < 0.2 * before)) J = this.jacobian(at, LOOSE);
      else if (last) {
        const whole = dot(last.change, last.change);
        const miss = felt.map((i, k) => image[i] - last.image[i] - dot(J[k], last.change));
        J = J.map((row, k) => row.map((value, l) => value + (miss[k] * last.change[l]) / whole));
      }
      const change = J && solved(J, felt.map((i) => image[i] - at[i]));
      if (!change) return null;
      last = { image, change };
      const next = [...image];
      felt.forEach((i, k) => (next[i] = at[i] + change[k]));
      before = away;
      at = next;
    }
    return null;
  }

  // A walk to where its steps repeat themselves, or to where it is lost.
  walk(start, most = GROUND_STEPS) {
    const states = [start];
    for (let taken = 0; taken < most; taken++) {
      const x = states[taken], { x: image, outcome } = this.step(x, LOOSE);
      if (outcome !== STEPPED) return { states, outcome, gait: null };
      states.push(image);
      const gait = LOOKS.includes(taken) && this.moved(x, image) < NEARBY ? this.near(image) : null;
      if (gait) return { states, outcome, gait };
    }
    return { states, outcome: STEPPED, gait: null };
  }

  // The walk from the first of these states from which it is not lost, else from the first.
  found(starts, most) {
    let lost = null;
    for (const start of starts) {
      const walk = this.walk(start(), most);
      if (walk.outcome === STEPPED) return walk;
      lost ||= walk;
    }
    return lost;
  }
}

// A step's motion for the page: rows as on springs, then the hub's place, lengths of legs 3 to n, and
// which leg's foot the second force is on; times, and what stands and slides in which stretch.
function motionOnGround(ground, { stretches, told }) {
  const { engine, legs: n, wheel, friction } = ground, S = engine.samples, span = 3 + n;
  const times = [], rows = Array.from({ length: 15 + n - 1 }, () => []), bands = [];
  let begin = 0;
  for (const stretch of stretches) {
    const duration = stretch[stretch.length - 1], contact = stretch.slice(2 * span, 2 * span + n);
    if (!(duration > 0)) continue;
    const [known] = engine.run("between", [SHOWN, friction], [[wheel], [stretch]], [[(span + 7) * S, true]]);
    const feet = contact.flatMap((mode, leg) => (mode ? [leg] : [])), none = [0, 0];
    for (let i = 0; i < S; i++) {
      const at = (row) => known[2 * (row * S + i)];
      const force = (slot) => [at(span + 2 + slot), at(span + slot)];
      const [first, second] = feet[0] === 0 ? [force(0), feet.length > 1 ? force(1) : none] : [none, feet.length ? force(0) : none];
      const lengths = Array.from({ length: n }, (_, leg) => at(3 + leg));
      const other = feet.find((leg) => leg > 0) ?? 1;
      const all = [at(2), lengths[0], lengths[1], 0, 0, 0, ...first, ...second, at(span + 4), at(span + 5), at(span + 6),
        at(0), at(1), ...lengths.slice(2), other];
      times.push(begin + (duration * i) / (S - 1));
      all.forEach((value, k) => rows[k].push(value));
    }
    begin += duration;
    const slides = contact.some((mode) => mode > 1), name = ["no foot", "one foot", "both feet"][Math.min(2, feet.length)];
    const text = `${name}${slides ? (feet.length > 1 ? ", sliding" : ", slides") : ""}`, last = bands[bands.length - 1];
    if (last?.texts[0] === text) last.duration += duration;
    else bands.push({ duration, texts: [text, name], shade: [0.1, 0.26, 0.5][Math.min(2, feet.length)] + (slides ? 0.12 : 0) });
  }
  return { times, rows, bands, period: begin, length: told[ground.names.indexOf("step_length")] };
}
