"use strict";
// The page: what is chosen, what it gives, and where it is shown.

const told = (id) => JSON.parse(document.getElementById(id).textContent);
const $ = (id) => document.getElementById(id);
const facts = told("facts"), packed = told("code");
const MEASURED = ["speed", "dls_fraction", "period", "step_length", "duration_dls", "duration_sls1", "duration_sls2",
  "theta_touchdown", "dtheta_touchdown", "energy_lost_landing", "energy_lost_stopper", "energy_lost_damping",
  "required_friction", ...["fore", "rear", "landing_fore", "landing_rear"].map((part) => `required_friction_${part}`)];
const INDICATORS = ["lambda_I4", "lambda_2_plus", "lambda_4_plus"];
const ON_GROUND = ["speed", "dls_fraction", "period", "step_length", "duration_dls", "duration_single", "duration_flight",
  "theta_touchdown", "dtheta_touchdown", "slip", "energy_lost_impacts", "energy_lost_damping", "energy_lost_friction"];
const ALIKE = ["speed", "dls_fraction", "period", "spectral_radius"];
const MAPPED = [...ALIKE, "required_friction", ...INDICATORS, ...Object.keys(facts.margins)];
const MAPPED_ON_GROUND = [...ALIKE, "slip", "energy_lost_friction", "duration_flight", ...facts.stoppers];
const PRESETS = {
  "Table 1": {},
  "two peaks": { damping: 100, slope: 0.075, stiffness: 2500, natural_length: 1 },
  "foot scuffs": { damping: 40 },
  "nearly unstable": { damping: 242, slope: 0.25, stiffness: 955, natural_length: 1.07, hub_mass: 22.1 },
  "unstable": { damping: 228, slope: 0.288, stiffness: 642, natural_length: 1.03, hub_mass: 11.1 },
  "early touchdown": { damping: 300 },
  "foot lifts off": { stiffness: 1000 },
  "falls back": { slope: 0.1 },
  "low friction": { friction: 0.3 },
  "rigid legs": { rung: "rigid", slope: 0.2 },
  "unilateral contact": { rung: "unilateral" },
  "on ice": { rung: "unilateral", friction: 0.2 },
};
const OUTCOME_COLORS = { 1: "#e69f00", 2: "#009e73", 3: "#56b4e9", 4: "#d55e00", 5: "#cc79a7", 6: "#999933", 7: "#882255",
  8: "#000000", 9: "#bbbbbb" };
const LAST = 64, FEWER = 32, LOST_STEPS = 60; // nodes of a picture's side, and with unilateral contact

const defaults = () => {
  const values = { friction: 1, n_legs: 8, rung: "viscoelastic" };
  for (const [name, parameter] of Object.entries(facts.parameters)) values[name] = parameter.value;
  return values;
};
const state = {
  values: defaults(), engines: {}, guess: null, result: null, took: 0,
  playing: !matchMedia("(prefers-reduced-motion: reduce)").matches,
  map: { x: "damping", y: "slope", measure: "speed", cells: new Map(), key: "", held: {} },
  basin: { cells: new Map(), key: "", cross: null, held: {} },
  ground: { key: "" },
};

const columnOf = (values) => facts.order.map((name) => values[name]);
const number = (value) => {
  const size = Math.abs(value);
  return value === 0 ? "0" : size < 1e-3 || size >= 1e5 ? value.toExponential(2) : +value.toPrecision(4) + "";
};
const unitText = (unit) => unit.replaceAll(" ", "·").replace("^2", "²").replace("/s²", "/s²");
const symbol = (name) => (name === "friction" ? "μ" : facts.parameters[name].symbol.replace("phi", "φ").replace("_", ""));
const set = (text) => text.replace("phi", "φ").replace(/_([A-Za-z0-9μ-]+)/g, "<sub>$1</sub>");
const signOf = (name) => (name === "friction" ? "μ" : set(facts.parameters[name].symbol));
const table = (caption, rows) => `<table><caption class="unseen">${caption}</caption><tbody>${rows.join("")}</tbody></table>`;
const parts = (list, count) => Array.from({ length: count }, (_, i) =>
  list.slice(Math.ceil((i * list.length) / count), Math.ceil(((i + 1) * list.length) / count)));
const named = (name) => name.replaceAll("_", " ");

const isReal = ({ rung }) => rung === "unilateral";
const codesOf = (legs) => [packed.shared, packed[legs]];

// ---- what a wheel gives

async function engineOf({ n_legs: legs, rung }) {
  state.engines[legs] ||= Engine.load(codesOf(legs), facts, legs);
  return (await state.engines[legs]).as(rung);
}

// The gait, or the walk that loses it, and all that is told of a step.
function computed(engine, values, guess) {
  if (isReal(values) && allowed(values)) return computedOnGround(engine, values, guess);
  const wheel = columnOf(values), guesses = guess ? [guess, facts.start] : [facts.start];
  const gait = allowed(values) ? engine.gait(wheel, guesses) : null;
  if (!gait) return walkedFrom(engine, values, guess || facts.start, LOST_STEPS);
  const step = engine.told(wheel, values.friction, gait.x);
  return { gait, outcome: step.outcome, steps: [stepOf(engine, step)], measures: step.measures };
}

// A walk's last steps, and how it ended.
function walkedFrom(engine, values, start, most) {
  const wheel = columnOf(values);
  const { states: [states], outcomes: [outcome] } = engine.walks(SHOWN, [wheel], [start], most);
  const shown = states.slice(-8).map((x) => engine.told(wheel, values.friction, x));
  const { measures } = shown[shown.length - 1];
  return { gait: null, outcome, taken: states.length - 1, steps: shown.map((step) => stepOf(engine, step)), measures };
}

// The same with unilateral contact: from the gait of the wheel before, from that of feet that stay, from Table 1's.
function computedOnGround(engine, values, guess) {
  const ground = new Ground(engine, columnOf(values), values.friction), springs = engine.as("viscoelastic");
  const stay = () => ground.begun(springs.gait(ground.wheel, [facts.start])?.x || facts.start);
  const gait = guess && ground.near(guess.x, guess.J), begins = [stay, () => ground.begun(facts.start)];
  if (gait) return shownOnGround(ground, { gait, outcome: STEPPED, states: [gait.x] });
  return shownOnGround(ground, ground.found(guess ? [() => guess.x, ...begins] : begins));
}

function shownOnGround(ground, { gait, states, outcome }) {
  const shown = (gait ? [gait.x] : states.slice(-8)).map((x) => ground.step(x));
  const steps = shown.map((step) => motionOnGround(ground, step)), measures = ground.measures(shown[shown.length - 1]);
  return { gait, outcome, taken: states.length - 1, steps, measures };
}

// Feet neither slide nor leave the ground here: the friction that the fore and the rear foot need.
const frictionNeeded = ({ measures }) => ["fore", "rear"].map((foot) =>
  Math.max(...["", "landing_"].map((when) => measures[`required_friction_${when}${foot}`])));

const allowed = (values) => values.leg_com < values.locked_length;

// A step's samples over all of its phases, row by row: theta, L1, L2, their rates, forces, energies.
function stepOf(engine, { measures, motion }) {
  const n = engine.samples, durations = ["dls", "sls1", "sls2"].map((name) => measures[`duration_${name}`]);
  const times = [], rows = Array.from({ length: 13 }, () => []);
  let begin = 0;
  durations.forEach((duration, phase) => {
    if (!(duration > 0)) return;
    const known = motion[motion.length - 3 + phase];
    for (let i = 0; i < n; i++) {
      times.push(begin + (known.length > 13 * n ? known[13 * n + i] : (duration * i) / (n - 1)));
      rows.forEach((row, k) => row.push(known[k * n + i]));
    }
    begin += duration;
  });
  if (!begin && motion.length === 1) {
    // A rigid wheel that does not get over its foot is shown where it landed.
    times.push(0, 0.2);
    rows.forEach((row, k) => row.push(motion[0][k * n], motion[0][k * n]));
    begin = 0.2;
  }
  const bands = durations.flatMap((duration, i) =>
    duration > 0 ? [{ duration, texts: [`${PHASES[i]}: ${PHASE_NAMES[i]}`, PHASES[i]], shade: [0.5, 0.32, 0.18][i] }] : []);
  return { bands, times, rows, period: begin, length: measures.step_length };
}

// ---- the walk on the screen

const walk = { index: 0, time: 0, place: 0, count: 0, prints: [0], trail: [], held: 0 };

function restart() {
  Object.assign(walk, { index: 0, time: 0, place: 0, count: 0, prints: [], trail: [], held: 0 });
}

function sampleAt(step, time) {
  const { times, rows } = step;
  if (!times.length) return null;
  let i = 0;
  while (i < times.length - 2 && times[i + 1] < time) i++;
  const span = times[i + 1] - times[i], share = span > 0 ? Math.min(1, Math.max(0, (time - times[i]) / span)) : 1;
  return rows.map((row) => row[i] + (row[i + 1] - row[i]) * share);
}

function moved(seconds) {
  const { steps, gait } = state.result;
  if (walk.held > 0) {
    // A lost walk stands still for a while before it is shown again.
    walk.held -= seconds;
    if (walk.held <= 0) restart();
    return;
  }
  walk.time += seconds;
  for (let turn = 0; turn < 4 && walk.time > steps[walk.index].period; turn++) {
    const step = steps[walk.index], last = walk.index === steps.length - 1;
    if (!gait && last && state.result.outcome !== STEPPED) {
      walk.time = step.period;
      walk.held = 1.6;
      return;
    }
    walk.time -= step.period;
    walk.place += step.length;
    walk.prints = [...walk.prints.slice(-12), walk.place];
    walk.count++;
    walk.index = last ? 0 : walk.index + 1;
    if (last && !gait) {
      // A walk that never settles begins anew.
      restart();
      return;
    }
  }
}

function show() {
  const { result, values } = state, step = result.steps[walk.index], sample = sampleAt(step, walk.time);
  if (!sample) return;
  const [theta, ...more] = sample, alpha = (2 * Math.PI) / values.n_legs, real = sample.length > 13;
  const lengths = Array.from({ length: values.n_legs }, (_, i) => (i < 2 ? more[i] : real ? sample[13 + i] : values.locked_length));
  const along = real ? [sample[13], sample[14]] : [lengths[0] * Math.sin(theta), lengths[0] * Math.cos(theta)];
  const hub = [walk.place + along[0], along[1]];
  const foot = (leg) => [hub[0] - lengths[leg] * Math.sin(theta + leg * alpha), hub[1] - lengths[leg] * Math.cos(theta + leg * alpha)];
  const rear = foot(real ? Math.round(sample[sample.length - 1]) : 1);
  const last = walk.trail[walk.trail.length - 1];
  if (!last || Math.hypot(last[0] - hub[0], last[1] - hub[1]) > 0.02) walk.trail = [...walk.trail.slice(-120), hub];
  const lost = walk.held > 0 && result.outcome !== STEPPED;
  drawWalk($("walk"), {
    wheel: values, theta, lengths, hub, step: walk.count,
    feet: [[...foot(0), sample[6], sample[7]], [...rear, sample[8], sample[9]]],
    prints: walk.prints, trail: walk.trail,
    caption: lost ? named(facts.outcomes[result.outcome].name.toLowerCase()) : `step ${walk.count + 1}`,
  });
  const weight = (values.hub_mass + values.n_legs * values.leg_mass) * values.gravity;
  drawStrips($("strips"), step, weight, walk.time);
  const slider = $("moment");
  if (document.activeElement !== slider || state.playing) slider.value = step.period ? walk.time / step.period : 0;
  slider.setAttribute("aria-valuetext", `${(walk.time * 1000).toFixed(0)} ms of ${(step.period * 1000).toFixed(0)}`);
}

let before = 0;
function tick(now) {
  const seconds = Math.min(0.1, (now - before) / 1000);
  before = now;
  if (state.result && state.playing) {
    moved(seconds * Number($("pace").value));
    show();
  }
  requestAnimationFrame(tick);
}

// ---- what is told in words

function leastOf(name) {
  const { measures } = state.result;
  if (!facts.margins[name]) return [measures[name], ""];
  const legs = Object.keys(measures).filter((key) => key.startsWith(`${name}[`));
  const least = legs.reduce((a, b) => (measures[a] < measures[b] ? a : b));
  return [measures[least], ` (leg ${least.slice(name.length + 1, -1)})`];
}

function tellVerdict() {
  const { result, values } = state, box = $("verdict"), { gait, outcome, measures } = result;
  const say = (kind, title, text) => {
    box.className = kind;
    box.innerHTML = `<b>${title}</b> <span>${text}</span>`;
  };
  if (!allowed(values)) return say("bad", "Impossible wheel", "The mass of a leg lies between foot and hub, so a must be less than L₀.");
  if (isReal(values)) return tellVerdictOnGround(say);
  if (gait) {
    const broken = Object.keys(facts.margins).filter((name) => leastOf(name)[0] < 0).length;
    const premises = broken ? ` <a href="#margins-title">${broken} of 13 margins are negative.</a>` : " All 13 margins are positive.";
    const both = values.rung === "rigid" ? "." : `, and double support lasts ${(100 * measures.dls_fraction).toFixed(1)} % of the step.`;
    const needs = frictionNeeded(result), slides = needs.map((need) => need > values.friction);
    const which = slides[0] ? (slides[1] ? "both feet would" : "the fore foot would") : "the rear foot would";
    const enough = slides.some((foot) => foot) ? `with ${number(values.friction)}, ${which} slide` : `${number(values.friction)} is enough`;
    const ground = ` The fore foot requires a friction coefficient of ${number(needs[0])}${needs[1] ? ` and the rear foot one of ${number(needs[1])}` : ""}; ${enough}.`;
    const how = `The wheel walks at ${number(measures.speed)} m/s, with ${number(measures.period)} s per step${both}${ground}`;
    if (outcome !== STEPPED) return say("bad", "The step failed", facts.outcomes[outcome].meaning);
    if (!isStable(gait)) return say("warn", "An unstable gait", `${how} A disturbance grows by a factor of ${radius(gait).toFixed(3)} per step.${premises}`);
    if (measures.friction_fore < 0) return say("warn", "A stable gait, but the fore foot would slip", `${how}${premises}`);
    if (measures.clearance_sls1 < 0 || measures.clearance_sls2 < 0)
      return say("warn", "A stable gait, but the rear foot scuffs", `${how} In this model it passes through the ground.${premises}`);
    return say("good", "A stable gait", `${how} A disturbance shrinks to ${(100 * radius(gait)).toFixed(1)} % per step.${premises}`);
  }
  tellLost(say);
}

// Of a walk without a gait.
function tellLost(say) {
  const { result } = state, { outcome } = result;
  if (result.from && outcome === STEPPED)
    return say("good", "The wheel walks from this start", "The picture repeats the last seven steps. Move a slider to return to the gait.");
  if (outcome === STEPPED)
    return say("warn", "The wheel walks without a gait of one step", `It made ${result.taken} steps that do not repeat.`);
  const steps = result.taken === 1 ? "one step" : `${result.taken} steps`;
  say("bad", `${result.from ? "From this start the walk" : "No gait: the walk"} ended ${result.taken ? `after ${steps}` : "in its first step"}`, facts.outcomes[outcome].meaning);
}

function tellVerdictOnGround(say) {
  const { gait, measures } = state.result;
  if (!gait) return tellLost(say);
  const slides = measures.slip > 1e-9 ? `; the feet slide ${number(100 * measures.slip)} cm per step` : "; no foot slides";
  const how = `The wheel walks at ${number(measures.speed)} m/s, with ${number(measures.period)} s per step, and double support lasts ${(100 * measures.dls_fraction).toFixed(1)} % of the step${slides}.`;
  const pulled = facts.stoppers.some((name) => measures[name] < 0);
  const stoppers = pulled ? ` <a href="#margins-title">A stopper pulls</a>; a stopper that only pushes would release the leg.` : "";
  if (isStable(gait)) return say("good", "A stable gait with unilateral contact", `${how} A disturbance shrinks to ${(100 * radius(gait)).toFixed(1)} % per step.${stoppers}`);
  say("warn", "An unstable gait with unilateral contact", `${how} A disturbance grows by a factor of ${radius(gait).toFixed(3)} per step.${stoppers}`);
}

function tellGait() {
  const { measures, gait } = state.result;
  $("gait-hint").textContent = gait ? "These values belong to one step of the gait." : "There is no gait. These values belong to the last step, up to its end.";
  const rows = (isReal(state.values) ? ON_GROUND : MEASURED).map((name) => {
    const m = facts.measures[name];
    return `<tr title="${m.meaning}"><th scope="row">${m.label} <i>${set(m.symbol)}</i></th><td data-measure="${name}">${measures[name] === 0 ? "–" : `${number(measures[name])} ${unitText(m.unit)}`}</td></tr>`;
  });
  $("gait").innerHTML = parts(rows, 3).map((some) => table("Measures of the step", some)).join("");
  const list = gait ? gait.multipliers : [];
  drawCircle($("circle"), list);
  const text = ({ re, im }) => (im ? `${number(re)} ${im < 0 ? "−" : "+"} ${number(Math.abs(im))}i` : number(re));
  $("multipliers").innerHTML = gait
    ? `Multipliers of the gait: ${list.map(text).join(", ")}. Spectral radius ρ = <b data-measure="spectral_radius">${number(radius(gait))}</b>.`
    : "Only a gait has multipliers.";
  $("circle").setAttribute("aria-label", $("multipliers").textContent);
}

function tellMargins() {
  const { values } = state, real = isReal(values), L = values.locked_length, mass = values.hub_mass + values.n_legs * values.leg_mass;
  const scale = { N: mass * values.gravity, "N s": 0.2 * mass * Math.sqrt(values.gravity * L), m: 0.2 * L, "": 1 };
  $("margins-hint").textContent = real
    ? "The model assumes that stoppers hold the legs in the air and may pull. Two margins measure this. Feet slide, lift and land by the laws of contact."
    : "The table shows three indicators of double support, and thirteen margins. A negative margin means that the motion violates an assumption of the model.";
  const rows = (real ? facts.stoppers : [...INDICATORS, ...Object.keys(facts.margins)]).map((name) => {
    const m = facts.measures[name], [value, leg] = INDICATORS.includes(name) ? [state.result.measures[name], ""] : leastOf(name);
    const broken = value < 0, share = 50 * Math.tanh(Math.abs(value) / scale[m.unit]);
    const bar = `<div class="bar" aria-hidden="true"><i style="${broken ? `right:50%` : `left:50%`};width:${share}%"></i></div>`;
    if (value === 0)
      return `<tr><th scope="row">${set(m.label)}<small>${m.meaning}</small></th><td></td><td data-measure="${name}">–<small>not reached</small></td></tr>`;
    return `<tr class="${broken ? "broken" : ""}"><th scope="row">${set(m.label)}${leg}<small>${broken ? m.breaks : m.meaning}</small></th>`
      + `<td>${bar}</td><td data-measure="${name}">${number(value)} ${unitText(m.unit)}<small>${broken ? "negative" : "positive"}</small></td></tr>`;
  });
  $("margins").innerHTML = parts(rows, 2).map((some) => table("Indicators and margins of the step", some)).join("");
}

function tellPython() {
  const base = defaults(), { values } = state;
  const changed = facts.order.concat("n_legs").filter((name) => values[name] !== base[name]).map((name) => `${name}=${values[name]}`);
  const friction = values.friction === base.friction ? "" : `friction=${values.friction}`, rigid = values.rung === "rigid";
  const real = isReal(values), kind = real ? "Unilateral" : rigid ? "Rigid" : "Viscoelastic";
  const model = real || rigid || friction ? `, model=vrw.${kind}Wheel(${real ? `friction=${values.friction}` : friction})` : "";
  $("python").textContent = `vrw.limit_cycle(vrw.WheelParams(${changed.join(", ")})${model})`;
}

// ---- maps and basins

const workers = {};
function send(kind, job) {
  job.kind = kind;
  job.id = `${kind} ${++send.count}`;
  workers[kind] ||= worker(news);
  const known = (workers[kind].known ||= new Set()), legs = state.values.n_legs;
  const first = known.has(legs) ? {} : { packed: codesOf(legs), facts };
  known.add(legs);
  workers[kind].post({ job: { ...job, legs, rung: state.values.rung }, ...first });
  return job.id;
}
send.count = 0;

// Beside the page, or where that is forbidden, within it, piece by piece.
function worker(hear) {
  const source = [$("engine"), $("on-ground"), $("worker")].map((script) => script.textContent).join("\n");
  const door = "\nconst hear = jobs((news) => postMessage(news)); onmessage = (event) => hear(event.data);";
  try {
    const own = new Worker(URL.createObjectURL(new Blob([source + door], { type: "text/javascript" })));
    own.onmessage = (event) => hear(event.data);
    return { post: (message) => own.postMessage(message) };
  } catch {
    return { post: jobs(hear) };
  }
}

function news({ kind, job, stride, nodes, done, walk }) {
  const picture = state[kind];
  if (picture.job !== job) return;
  if (kind === "ground") {
    Object.assign(picture, { done, walk });
    return tellGround();
  }
  if (done) {
    picture.done = true;
    picture.seconds = (performance.now() - picture.began) / 1000;
  } else
    for (const node of nodes) {
      const key = node.node.join();
      picture.cells.set(key, { ...node, stride });
    }
  picture.stale = true;
  if (!picture.waits) {
    picture.waits = true;
    requestAnimationFrame(() => {
      picture.waits = false;
      kind === "map" ? showMap() : showBasin();
    });
  }
}

function axisOf(name) {
  if (name === "friction") return { name, from: 0, to: 2, index: facts.order.length, label: "friction μ" };
  const { from, to, unit } = facts.parameters[name];
  return { name, from, to, index: facts.order.indexOf(name), label: `${named(name)} ${symbol(name)}${unit ? ` [${unitText(unit)}]` : ""}` };
}

const ZOOM = { friction: [0.1, 1.5], damping: [20, 320], slope: [0.15, 0.45], stiffness: [250, 900], natural_length: [0.97, 1.12] };
const mapAxis = (name) => {
  const axis = axisOf(name);
  return ZOOM[name] ? { ...axis, from: ZOOM[name][0], to: ZOOM[name][1] } : axis;
};

const mapAxes = () => {
  const { given, x, y } = state.map;
  return given ? [given.x, given.y] : [mapAxis(x), mapAxis(y)];
};

function askMap() {
  const { map, values, result } = state;
  const others = facts.order.concat("n_legs", "friction", "rung").filter((name) => name !== map.x && name !== map.y);
  const key = JSON.stringify([map.x, map.y, others.map((name) => values[name])]);
  if (key === map.key || !result || map.given) return showMap();
  map.key = key;
  map.done = false;
  map.began = performance.now();
  map.cells = new Map();
  map.last = isReal(values) ? FEWER : LAST;
  const x = mapAxis(map.x), y = mapAxis(map.y), share = (axis) => (map.last * (values[axis.name] - axis.from)) / (axis.to - axis.from);
  map.job = send("map", {
    wheel: columnOf(values), x, y, friction: values.friction, last: map.last, batch: 32,
    guess: state.guess || (isReal(values) ? null : facts.start), dot: [share(x), share(y)],
  });
}

function mapValue(cell) {
  const { measure, given } = state.map;
  if (given) return given.measures[measure][cell.node[1]][cell.node[0]];
  if (!cell.told) return null;
  if (measure === "spectral_radius") return cell.radius;
  if (!Array.isArray(cell.told)) return cell.told[measure] ?? null;
  const rows = facts.rows[state.values.n_legs], at = (name) => cell.told[rows.indexOf(name)];
  const period = at("duration_dls") + at("duration_sls1") + at("duration_sls2");
  if (measure === "period") return period;
  if (measure === "speed") return at("step_length") / period;
  if (measure === "dls_fraction") return at("duration_dls") / period;
  if (!facts.margins[measure]) return at(measure);
  return Math.min(...rows.flatMap((name, i) => (name.startsWith(`${measure}[`) ? [cell.told[i]] : [])));
}

const coarseFirst = (cells) => [...cells.values()].sort((a, b) => b.stride - a.stride);

// What of the map changes with its cells and its measure alone.
function colored() {
  const { map } = state, cells = coarseFirst(map.cells), found = cells.map(mapValue);
  const finite = found.filter((value) => value !== null && isFinite(value)).sort((a, b) => a - b);
  const low = finite[Math.floor(0.01 * finite.length)], high = finite[Math.ceil(0.99 * finite.length) - 1];
  const codes = new Set();
  const drawn = cells.map((cell, i) => {
    if (found[i] === null) {
      codes.add(cell.outcome);
      return { ...cell, color: lostColor(cell.outcome) };
    }
    const [r, g, b] = shade(high > low ? (found[i] - low) / (high - low) : 0.5);
    return { ...cell, color: `rgb(${r},${g},${b})`, hatched: cell.radius >= 1 };
  });
  const m = facts.measures[map.measure] || { label: named(map.measure), unit: "" }, unit = unitText(m.unit);
  const bar = `<span><span style="width:90px;height:12px;border-radius:3px;background:linear-gradient(90deg,${VIRIDIS.map(
    (rgb) => `rgb(${rgb})`).join(",")})"></span></span>`;
  $("map-legend").innerHTML = (finite.length ? `<span>${m.label}: ${number(low)}</span>${bar}<span>${number(high)} ${unit}</span>` : "")
    + [...codes].sort().map((code) => swatch(lostColor(code), lostName(code))).join("");
  Object.assign(map, { drawn, drawnOf: [map.cells, map.cells.size, map.measure], label: m.label });
}

function showMap() {
  const { map, values } = state, [x, y] = mapAxes(), last = map.given ? [x.last, y.last] : map.last;
  const now = [map.cells, map.cells.size, map.measure];
  if (map.stale || now.some((what, i) => what !== map.drawnOf?.[i])) colored();
  map.stale = false;
  map.place = drawGrid($("map"), { last, cells: map.drawn, held: map.held, x, y, dot: [values[map.x], values[map.y]] });
  $("map-state").textContent = map.given ? "The map shows your dataset." : map.done ? `${map.cells.size.toLocaleString("en")} gaits in ${map.seconds.toFixed(1)} s.` : "Computing more points …";
  $("map").setAttribute("aria-label", `Map of ${map.label} over ${named(map.x)}, now ${values[map.x]}, and ${named(map.y)}, now ${values[map.y]}`);
}

const lostColor = (code) => (code === STEPPED ? "#9aa0a8" : OUTCOME_COLORS[code] || "#555555");
const lostName = (code) => (code === STEPPED ? "walks without a gait of one step" : named(facts.outcomes[code].name.toLowerCase()));
const swatch = (color, text) => `<span><i class="swatch" style="background:${color}"></i>${text}</span>`;

function basinAxes() {
  const [theta, rate] = state.result.gait.x;
  const symbols = ["theta_touchdown", "dtheta_touchdown"].map((name) => facts.measures[name]);
  const label = ({ symbol, unit }) => `${symbol} [${unit}]`;
  // With unilateral contact no foot starts below the ground, and no leg beyond its stopper.
  const [from, to] = isReal(state.values) ? [0, Math.PI / state.values.n_legs] : [theta - 0.4, theta + 0.4];
  return [
    { from, to, label: label(symbols[0]) },
    { from: 0, to: Math.max(3, 1.6 * rate), label: label(symbols[1]) },
  ];
}

function askBasin() {
  const { basin, values, result } = state, canvas = $("basin");
  if (!result.gait || !isStable(result.gait)) {
    basin.key = basin.job = "";
    basin.cells = new Map();
    basin.axes = null;
    canvas.hidden = true;
    $("basin-legend").textContent = "There is no stable gait, and so no basin.";
    $("basin-state").textContent = "";
    return;
  }
  canvas.hidden = false;
  const real = isReal(values), last = (real ? FEWER : LAST) - 1, rate = result.gait.x[real ? 4 + values.n_legs : 2];
  const key = JSON.stringify([columnOf(values), values.n_legs, values.rung, real && values.friction]);
  if (key === basin.key) return showBasin();
  const [x, y] = basinAxes();
  Object.assign(basin, { key, axes: [x, y], done: false, began: performance.now(), cells: new Map(), cross: result.gait.x.slice(0, 2), gait: result.gait.x, last, rate });
  basin.job = send("basin", { wheel: columnOf(values), friction: values.friction, gait: result.gait.x, x, y, last, rate });
}

function showBasin() {
  const { basin } = state;
  if (!basin.axes) return;
  if (basin.stale || basin.drawnOf !== basin.cells) {
    const color = (code) => (code === SETTLED ? "#0072b2" : lostColor(code));
    basin.drawn = coarseFirst(basin.cells).map((cell) => ({ ...cell, color: color(cell.code) }));
    Object.assign(basin, { stale: false, drawnOf: basin.cells });
  }
  const codes = new Set([...basin.cells.values()].map(({ code }) => code));
  const home = [...basin.cells.values()].filter(({ code }) => code === SETTLED).length;
  basin.place = drawGrid($("basin"), { last: basin.last, cells: basin.drawn, held: basin.held, x: basin.axes[0], y: basin.axes[1], cross: basin.cross, dot: basin.gait });
  $("basin-legend").innerHTML = [...codes].sort((a, b) => a - b).map((code) =>
    swatch(code === SETTLED ? "#0072b2" : lostColor(code), code === SETTLED ? "to the gait" : code === STEPPED ? (isReal(state.values) ? "walks, not to the gait" : "walks without a gait of one step") : lostName(code))).join("");
  const share = `${((100 * home) / Math.max(1, basin.cells.size)).toFixed(0)} % of the starts lead to the gait`;
  $("basin-state").textContent = basin.done ? `${share}; ${basin.cells.size.toLocaleString("en")} starts in ${basin.seconds.toFixed(1)} s.` : `${share} so far.`;
  $("basin").setAttribute("aria-label", `Basin of the gait: ${share}`);
}

// ---- with unilateral contact

function askGround() {
  if (isReal(state.values)) return;
  const { ground, values, result } = state, start = result.gait?.x || facts.start;
  const key = JSON.stringify([columnOf(values), values.n_legs, values.friction, start]);
  if (key === ground.key) return;
  Object.assign(ground, { key, start, done: false, walk: null });
  if (allowed(values)) ground.job = send("ground", { wheel: columnOf(values), friction: values.friction, start });
  tellGround();
}

function tellGround() {
  const { walk, start } = state.ground, { rung, friction } = state.values;
  const from = start === facts.start ? "the start of Table 1" : `the gait of ${rung === "rigid" ? "rigid legs" : "the springs above"}`;
  const pace = walk && `speed ${number(walk.speed)} m/s, period ${number(walk.period)} s, double support ${(100 * walk.dls_fraction).toFixed(1)} %.`;
  const how = !walk ? "Walking …"
    : walk.outcome !== STEPPED ? `The walk ended after ${walk.taken === 1 ? "one step" : `${walk.taken} steps`}: ${facts.outcomes[walk.outcome].meaning}`
      : walk.gait ? `The wheel has a gait: after ${walk.taken} steps, each step equals the previous one; ${pace}`
        : `The wheel made ${walk.taken} steps that do not repeat; last step: ${pace}`;
  $("ground").className = !walk || walk.gait ? "" : walk.outcome === STEPPED ? "warn" : "bad";
  $("ground").innerHTML = `From ${from}, friction ${number(friction)}. <b>${how}</b>`;
}

// ---- what is chosen

let asked = 0;
function later() {
  clearTimeout(asked);
  asked = setTimeout(() => {
    askMap();
    askBasin();
    askGround();
    remember();
  }, 120);
}

function tell() {
  $("ground-card").hidden = isReal(state.values);
  tellVerdict();
  tellGait();
  tellMargins();
  tellPython();
  show();
}

async function update(changes = {}) {
  Object.assign(state.values, changes);
  const { values } = state, { n_legs: legs, rung } = values, began = performance.now();
  const engine = await engineOf(values);
  if (values.n_legs !== legs || values.rung !== rung) return;
  if (state.legs !== legs || state.rung !== rung) state.guess = null;
  Object.assign(state, { legs, rung });
  state.result = computed(engine, values, state.guess);
  const { gait } = state.result;
  if (gait && isStable(gait)) state.guess = isReal(values) ? gait : gait.x;
  state.took = performance.now() - began;
  // The walk goes on where it was, unless its steps are others.
  const share = walk.step ? walk.time / (walk.step.period || 1) : 0;
  if (!state.result.gait || walk.lost) restart();
  else walk.time = share * state.result.steps[0].period;
  walk.lost = !state.result.gait;
  walk.index = Math.min(walk.index, state.result.steps.length - 1);
  walk.step = state.result.steps[walk.index];
  for (const [name, value] of Object.entries(values)) showValue(name, value);
  offerMaps();
  tell();
  showMap();
  document.querySelector("[data-told=legs]").textContent = { 6: "six", 8: "eight", 10: "ten" }[legs];
  $("took").textContent = `${state.took.toFixed(1)} ms`;
  later();
  tellParent({ vrw: "values", values: { ...values }, measures: spoken(state.result) });
}

// In a notebook the page is a widget's, which hears what is shown.
const tellParent = (news) => window.parent !== window && window.parent.postMessage(news, "*");
const spoken = ({ measures, gait, outcome }) =>
  ({ ...measures, outcome, ...(gait ? { spectral_radius: radius(gait), gait: gait.x } : {}) });

function known(given) {
  const values = {};
  for (const [name, text] of Object.entries(given)) {
    if (name === "rung" ? text in facts.rungs : name in state.values && isFinite(Number(text)))
      values[name] = name === "rung" ? text : Number(text);
  }
  return values;
}

// A scan's dataset in place of what the page computes: two axes, and rows of measures over them.
function giveMap(given) {
  if (!given?.axes) return;
  const { map } = state, [x, y] = given.axes.map(({ name, values }) => (
    { ...axisOf(name), from: values[0], to: values[values.length - 1], last: values.length - 1 }));
  Object.assign(map, { given: { ...given, x, y }, x: x.name, y: y.name, job: "", done: true, cells: new Map() });
  const names = Object.keys(given.measures);
  map.measure = names.includes(map.measure) ? map.measure : names[0];
  $("map-measure").innerHTML = names.map((name) => `<option value="${name}">${facts.measures[name]?.label || named(name)}</option>`).join("");
  $("map-measure").value = map.measure;
  for (const side of ["x", "y"]) {
    $(`map-${side}`).value = map[side];
    $(`map-${side}`).disabled = true;
  }
  given.outcome.forEach((row, r) => row.forEach((outcome, c) => map.cells.set(`${c},${r}`, { node: [c, r], stride: 1, outcome })));
  showMap();
}

// What the map may show, by the rung.
function offerMaps() {
  const { map, values } = state, real = isReal(values), measures = real ? MAPPED_ON_GROUND : MAPPED;
  if (map.given || map.offered === real) return;
  map.offered = real;
  const options = (names, text) => names.map((name) => `<option value="${name}">${text(name)}</option>`).join("");
  const axes = [...Object.keys(facts.parameters), ...(real ? ["friction"] : [])];
  if (!measures.includes(map.measure)) map.measure = "speed";
  for (const [side, usual] of [["x", "damping"], ["y", "slope"]]) if (!axes.includes(map[side])) map[side] = usual;
  if (map.x === map.y) map.x = map.y === "damping" ? "slope" : "damping";
  $("map-measure").innerHTML = options(measures, (name) => facts.measures[name].label);
  $("map-measure").value = map.measure;
  for (const side of ["x", "y"]) {
    $(`map-${side}`).innerHTML = options(axes, (name) => `${named(name)} ${symbol(name)}`);
    $(`map-${side}`).value = map[side];
  }
}

function showValue(name, value) {
  const number = $(`number-${name}`), slider = $(`slider-${name}`);
  if (document.activeElement !== number) number.value = typeof value === "string" ? value : +value.toPrecision(6);
  if (slider && Number(slider.value) !== value) slider.value = value;
}

// Seven steps from a start of the basin's picture.
async function walkFrom(place) {
  const { basin, values } = state;
  if (!basin.gait) return;
  basin.cross = place;
  const engine = await engineOf(values);
  const start = [...place, basin.rate], ground = isReal(values) && new Ground(engine, columnOf(values), values.friction);
  const walked = ground ? shownOnGround(ground, { ...ground.walk(ground.begun(start), 7), gait: null }) : walkedFrom(engine, values, start, 7);
  state.result = { ...walked, from: place };
  restart();
  walk.lost = true;
  tell();
  showBasin();
}

function remember() {
  const base = defaults(), changed = Object.entries(state.values).filter(([name, value]) => value !== base[name]);
  const text = changed.map(([name, value]) => `${name}=${value}`).join("&");
  try {
    history.replaceState(null, "", text ? `#${text}` : location.pathname + location.search);
  } catch {
    // Pages within a frame have no address of their own.
  }
}

function fromAddress() {
  const values = known(Object.fromEntries(new URLSearchParams(location.hash.slice(1))));
  if (!facts.legs.includes(values.n_legs ?? 8)) delete values.n_legs;
  return values;
}

// ---- building and listening

function built() {
  const rows = Object.entries(facts.parameters).map(([name, p]) => [name, signOf(name), p.unit, p.meaning, p.from, p.to]);
  rows.push(["friction", "μ", "", "friction coefficient, for unilateral contact and for margins", 0, 2]);
  const step = (from, to) => 10 ** Math.floor(Math.log10((to - from) / 400));
  $("sliders").innerHTML = rows.map(([name, sign, unit, meaning, from, to]) =>
    `<div class="slider" title="${meaning}"><label for="slider-${name}">${named(name)} <i>${sign}</i></label>`
    + `<input type="number" id="number-${name}" step="any" aria-label="${named(name)}, a number, ${unit}"><span class="unit">${unitText(unit)}</span>`
    + `<input type="range" id="slider-${name}" min="${from}" max="${to}" step="${step(from, to)}" aria-describedby="about-${name}"><span id="about-${name}" class="unseen">${meaning}</span></div>`).join("")
    + `<div class="slider"><label for="number-n_legs">number of legs <i>n</i></label><select id="number-n_legs">${facts.legs.map((n) => `<option>${n}</option>`).join("")}</select></div>`
    + `<div class="slider"><label for="number-rung">model</label><select id="number-rung" aria-describedby="about-rung">${Object.entries(facts.rungs).map(([name, text]) => `<option value="${name}">${text}</option>`).join("")}</select><span id="about-rung" class="unseen">springs or rigid legs with feet that never slip, or springs with unilateral contact</span></div>`;
  for (const [name] of rows) {
    const least = facts.parameters[name]?.least ?? 0, above = name === "slope" ? -1.5 : least;
    $(`slider-${name}`).addEventListener("input", (event) => update({ [name]: Number(event.target.value) }));
    $(`number-${name}`).addEventListener("change", (event) => {
      const value = Number(event.target.value);
      if (event.target.value !== "" && isFinite(value) && value >= above) update({ [name]: value });
      else showValue(name, state.values[name]);
    });
  }
  $("number-n_legs").addEventListener("change", (event) => update({ n_legs: Number(event.target.value) }));
  $("number-rung").addEventListener("change", (event) => update({ rung: event.target.value }));
  $("presets").innerHTML = Object.keys(PRESETS).map((name) => `<button type="button">${name}</button>`).join("");
  [...$("presets").children].forEach((button) => button.addEventListener("click", () => {
    state.guess = null;
    restart();
    update({ ...defaults(), ...PRESETS[button.textContent] });
  }));
  for (const side of ["x", "y"]) {
    $(`map-${side}`).addEventListener("change", (event) => {
      const other = side === "x" ? "y" : "x";
      if (state.map[other] === event.target.value) {
        state.map[other] = state.map[side];
        $(`map-${other}`).value = state.map[other];
      }
      state.map[side] = event.target.value;
      askMap();
    });
  }
  $("map-measure").addEventListener("change", (event) => {
    state.map.measure = event.target.value;
    showMap();
  });
  $("play").addEventListener("click", () => play(!state.playing));
  play(state.playing);
  $("moment").addEventListener("input", (event) => {
    play(false);
    walk.held = 0;
    walk.time = Number(event.target.value) * state.result.steps[walk.index].period;
    show();
  });
  dragged($("map"), (place) => {
    const [a, b] = state.map.place(place), round = (v) => +v.toPrecision(4);
    update({ [state.map.x]: round(a), [state.map.y]: round(b) });
  }, (dx, dy) => {
    const axes = mapAxes(), by = [dx, dy];
    const values = axes.map((axis, i) => state.values[axis.name] + (by[i] * (axis.to - axis.from)) / LAST);
    const inside = axes.map((axis, i) => +Math.min(axis.to, Math.max(axis.from, values[i])).toPrecision(4));
    update({ [axes[0].name]: inside[0], [axes[1].name]: inside[1] });
  });
  dragged($("basin"), (place) => state.basin.place && walkFrom(state.basin.place(place)), (dx, dy, enter) => {
    const { basin } = state;
    if (!basin.cross) return;
    const move = basin.axes.map((axis) => (axis.to - axis.from) / LAST);
    basin.cross = [basin.cross[0] + dx * move[0], Math.max(1e-3, basin.cross[1] + dy * move[1])];
    enter ? walkFrom(basin.cross) : showBasin();
  });
  $("strip-legend").innerHTML = [["one", "force on foot 1"], ["two", "on foot 2"], ["soft", "dotted: weight; dashed: along the slope"],
    ["ink", "energy, total"], ["three", "kinetic"], ["other", "of height"], ["four", "of springs"]]
    .map(([name, text]) => `<span><i class="swatch" style="background:var(--${name})"></i>${text}</span>`).join("");
  for (const place of document.querySelectorAll("[data-told]")) place.textContent = facts[place.dataset.told] || place.textContent;
  
  new ResizeObserver(() => state.result && (show(), showMap(), showBasin(), tellGait())).observe($("walk"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => state.result && update());
  window.addEventListener("hashchange", () => update({ ...defaults(), ...fromAddress() }));
  window.addEventListener("message", ({ data }) => {
    if (data?.vrw === "set") update(known(data.values));
    if (data?.vrw === "map") giveMap(data.given);
  });
}

function play(on) {
  state.playing = on;
  $("play").textContent = on ? "Pause" : "Play";
  $("play").setAttribute("aria-pressed", String(on));
}

function dragged(canvas, to, by) {
  const move = (event) => {
    const box = canvas.getBoundingClientRect();
    to([event.clientX - box.left, event.clientY - box.top]);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    move(event);
  });
  canvas.addEventListener("pointermove", (event) => canvas.hasPointerCapture(event.pointerId) && move(event));
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1], Enter: [0, 0, true] };
  canvas.addEventListener("keydown", (event) => {
    if (!arrows[event.key]) return;
    event.preventDefault();
    by(...arrows[event.key]);
  });
}

const ready = (async () => {
  built();
  await update(fromAddress());
  tellParent({ vrw: "ready" });
  requestAnimationFrame(tick);
})();
ready.catch((error) => {
  $("verdict").className = "bad";
  $("verdict").innerHTML = `<b>This browser cannot run the page</b> <span>The page requires WebAssembly with SIMD (2021) and DecompressionStream (2023): ${error}</span>`;
});
window.vrw = { ready, state, update };
