"use strict";
// What is drawn, from numbers alone. Lengths in m on the slope's frame: x downhill, z off the slope.

// Colours of the page's style, until it turns light or dark.
const inks = {};
const ink = (name) => (inks[name] ||= getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => Object.keys(inks).forEach((name) => delete inks[name]));

// A canvas at the screen's own resolution, and its size in CSS pixels.
function sheet(canvas) {
  const { clientWidth: w, clientHeight: h } = canvas, dense = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(w * dense) || canvas.height !== Math.round(h * dense)) {
    canvas.width = Math.round(w * dense);
    canvas.height = Math.round(h * dense);
  }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(dense, 0, 0, dense, 0, 0);
  ctx.clearRect(0, 0, w, h);
  ctx.lineCap = ctx.lineJoin = "round";
  ctx.font = "12px system-ui, sans-serif";
  return { ctx, w, h };
}

function line(ctx, points, color, width, dash = []) {
  ctx.strokeStyle = color;
  ctx.lineWidth = width;
  ctx.setLineDash(dash);
  ctx.beginPath();
  points.forEach(([x, y], i) => (i ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
  ctx.stroke();
  ctx.setLineDash([]);
}

function disc(ctx, [x, y], r, fill, edge) {
  ctx.beginPath();
  ctx.arc(x, y, r, 0, 2 * Math.PI);
  ctx.fillStyle = fill;
  ctx.fill();
  if (edge) {
    ctx.strokeStyle = edge;
    ctx.lineWidth = 1.5;
    ctx.stroke();
  }
}

function arrow(ctx, [x, y], [dx, dy], color) {
  const length = Math.hypot(dx, dy);
  if (length < 3) return;
  const [ux, uy] = [dx / length, dy / length], head = Math.min(9, length / 2), tip = [x + dx, y + dy];
  line(ctx, [[x, y], [tip[0] - ux * head * 0.7, tip[1] - uy * head * 0.7]], color, 3);
  ctx.fillStyle = color;
  ctx.beginPath();
  ctx.moveTo(...tip);
  ctx.lineTo(tip[0] - head * (ux + 0.5 * uy), tip[1] - head * (uy - 0.5 * ux));
  ctx.lineTo(tip[0] - head * (ux - 0.5 * uy), tip[1] - head * (uy + 0.5 * ux));
  ctx.fill();
}

// `scene`: wheel (parameters by name), theta, lengths of legs, place of the hub, places and forces of two
// feet, steps taken, footprints, trail of the hub.
function drawWalk(canvas, scene) {
  const { ctx, w, h } = sheet(canvas), { wheel, hub } = scene, L0 = wheel.locked_length, legs = scene.lengths.length;
  const scale = Math.min(h / (2.62 * L0), w / (2.4 * L0));
  const [sin, cos] = [Math.sin(wheel.slope), Math.cos(wheel.slope)];
  const foot = hub[0]; // the camera looks at the slope below the hub
  const ground = h - 0.34 * L0 * scale - 0.05 * w * sin;
  const at = ([x, z]) => [
    w * 0.46 + scale * ((x - foot) * cos + z * sin),
    ground + scale * ((x - foot) * sin - z * cos),
  ];
  const reach = (w + h) / scale;

  const [left, right] = [at([foot - reach, 0]), at([foot + reach, 0])];
  ctx.fillStyle = ink("ground");
  ctx.beginPath();
  ctx.moveTo(...left);
  ctx.lineTo(...right);
  ctx.lineTo(right[0], h + 2000);
  ctx.lineTo(left[0], h + 2000);
  ctx.fill();
  line(ctx, [left, right], ink("soft"), 1.5);
  const unit = L0 > 0.5 ? 0.5 : 0.25;
  ctx.fillStyle = ink("soft");
  for (let i = Math.ceil((foot - reach) / unit); i * unit < foot + reach; i++) {
    const major = i % 2 === 0, x = i * unit;
    line(ctx, [at([x, 0]), at([x, major ? -0.07 * L0 : -0.035 * L0])], ink("soft"), 1);
    if (major) {
      ctx.save();
      ctx.translate(...at([x, -0.15 * L0]));
      ctx.rotate(wheel.slope);
      ctx.textAlign = "center";
      ctx.fillText(`${x.toFixed(unit < 0.5 ? 1 : 0)} m`, 0, 4);
      ctx.restore();
    }
  }
  for (const x of scene.prints) disc(ctx, at([x, 0]), 3, ink("soft"));
  if (scene.trail.length > 1) line(ctx, scene.trail.map(at), ink("other"), 1.2, [2, 4]);

  const middle = at(hub), mass = (m) => Math.max(2.2, 0.052 * scale * L0 * Math.cbrt(m));
  for (let i = legs; i >= 1; i--) {
    const length = scene.lengths[i - 1];
    const angle = scene.theta + ((i - 1) * 2 * Math.PI) / legs;
    const along = [-Math.sin(angle), -Math.cos(angle)]; // from the hub to the foot
    const place = (r) => at([hub[0] + along[0] * r, hub[1] + along[1] * r]);
    const color = i === 1 ? ink("one") : i === 2 ? ink("two") : ink("other");
    drawLeg(ctx, place, length, L0, color, i <= 2 ? 3 : 2, wheel.leg_com);
    const marked = (i - 1 + scene.step) % legs === 0; // one leg can be followed through its turns
    disc(ctx, place(length - wheel.leg_com), mass(wheel.leg_mass), marked ? ink("card") : color, color);
  }
  disc(ctx, middle, Math.max(5, mass(wheel.hub_mass)), ink("ink"));
  disc(ctx, middle, 2.5, ink("card"));
  const weight = (wheel.hub_mass + legs * wheel.leg_mass) * wheel.gravity;
  const pull = (0.6 * L0 * scale) / weight;
  scene.feet.forEach(([x, z, along, off], i) => {
    const turned = [along * cos + off * sin, along * sin - off * cos];
    arrow(ctx, at([x, z]), [turned[0] * pull, turned[1] * pull], ink(i ? "two" : "one"));
  });
  ctx.fillStyle = ink("soft");
  ctx.textAlign = "left";
  ctx.fillText(scene.caption, 8, h - 8);
}

function drawLeg(ctx, place, length, L0, color, width, com) {
  // A foot with its rod, a spring, and a guide in the hub.
  const rod = Math.min(Math.max(com + 0.06 * L0, 0.3 * L0), 0.6 * L0), guide = 0.14 * L0;
  const [bottom, top] = [length - rod, guide], turns = 5, wide = 0.035 * L0;
  line(ctx, [place(length), place(bottom)], color, width);
  line(ctx, [place(0), place(top)], color, width);
  const [a, b] = [place(top), place(bottom)];
  const d = [b[0] - a[0], b[1] - a[1]], size = Math.hypot(...d) || 1;
  const side = (wide / (length || 1)) * Math.hypot(place(length)[0] - place(0)[0], place(length)[1] - place(0)[1]);
  const normal = [(-d[1] / size) * side, (d[0] / size) * side], points = [a];
  for (let k = 0; k < 2 * turns; k++) {
    const share = (k + 0.5) / (2 * turns), sign = k % 2 ? 1 : -1;
    points.push([a[0] + d[0] * share + sign * normal[0], a[1] + d[1] * share + sign * normal[1]]);
  }
  line(ctx, [...points, b], color, Math.max(1.2, width - 1.4));
  disc(ctx, place(length), width, color);
}

const PHASES = ["DLS", "SLS-I", "SLS-II"];
const PHASE_NAMES = ["both feet", "one foot, spring free", "one foot, stopper"];

// `step`: bands, times, samples by row over all of them; `now`: s since the landing.
function drawStrips(canvas, step, weight, now) {
  const { ctx, w, h } = sheet(canvas), left = 46, right = w - 8, total = step.period || 1;
  const X = (t) => left + ((right - left) * t) / total, band = 20;
  let begin = 0;
  step.bands.forEach(({ duration, texts, shade }, i) => {
    const [x0, x1] = [X(begin), X(begin + duration)];
    ctx.globalAlpha = shade;
    ctx.fillStyle = ink("accent");
    ctx.fillRect(x0, 0, x1 - x0 - 1, band);
    ctx.globalAlpha = 0.07 * (i % 2 ? 0 : 1);
    ctx.fillRect(x0, band, x1 - x0 - 1, h - band - 18);
    ctx.globalAlpha = 1;
    ctx.fillStyle = ink("ink");
    ctx.textAlign = "center";
    const room = x1 - x0 - 8, text = texts.find((some) => ctx.measureText(some).width < room);
    if (text) ctx.fillText(text, (x0 + x1) / 2, 14);
    begin += duration;
  });
  const half = (h - band - 18) / 2;
  plot(ctx, step, X, [left, right], [band + 8, band + half - 6], "N", [
    [step.rows[7], ink("one"), []], [step.rows[9], ink("two"), []],
    [step.rows[6], ink("one"), [2, 3]], [step.rows[8], ink("two"), [2, 3]],
  ], weight);
  const less = (row) => {
    const least = Math.min(...row);
    return row.map((value) => value - least);
  };
  const [K, P, S] = [10, 11, 12].map((i) => step.rows[i]), E = K.map((_, i) => K[i] + P[i] + S[i]);
  plot(ctx, step, X, [left, right], [band + half + 8, h - 22], "J", [
    [less(E), ink("ink"), []], [less(K), ink("three"), []], [less(P), ink("other"), []],
    [less(S), ink("four"), []],
  ], null);
  ctx.fillStyle = ink("soft");
  ctx.textAlign = "left";
  ctx.fillText("0", left, h - 6);
  ctx.textAlign = "right";
  ctx.fillText(`${total.toFixed(3)} s`, right, h - 6);
  line(ctx, [[X(now), 0], [X(now), h - 18]], ink("ink"), 1.2);
}

function plot(ctx, step, X, [left, right], [top, bottom], unit, rows, dotted) {
  const all = rows.flatMap(([row]) => [...row]);
  if (dotted !== null) all.push(dotted);
  const low = Math.min(0, ...all), high = Math.max(1e-9, ...all), span = high - low;
  const Y = (value) => bottom - ((bottom - top) * (value - low)) / span;
  const tick = 10 ** Math.floor(Math.log10(span)), every = span / tick > 5 ? 2 * tick : span / tick > 2 ? tick : tick / 2;
  ctx.fillStyle = ink("soft");
  ctx.textAlign = "right";
  for (let v = Math.ceil(low / every) * every; v <= high; v += every) {
    line(ctx, [[left, Y(v)], [right, Y(v)]], ink("line"), v === 0 ? 1.4 : 0.7);
    ctx.fillText(+v.toPrecision(6) + (v + every > high ? ` ${unit}` : ""), left - 5, Y(v) + 4);
  }
  if (dotted !== null) line(ctx, [[left, Y(dotted)], [right, Y(dotted)]], ink("soft"), 1, [1, 4]);
  for (const [row, color, dash] of rows)
    line(ctx, [...row].map((value, i) => [X(step.times[i]), Y(value)]), color, dash.length ? 1.3 : 2, dash);
}

function drawCircle(canvas, multipliers) {
  const { ctx, w, h } = sheet(canvas);
  const far = Math.max(1, ...multipliers.map((m) => Math.hypot(m.re, m.im)));
  const r = Math.min(w, h) / 2 - 14, unit = r / Math.min(far, 3), at = (re, im) => [w / 2 + unit * re, h / 2 - unit * im];
  line(ctx, [[0, h / 2], [w, h / 2]], ink("line"), 1);
  line(ctx, [[w / 2, 0], [w / 2, h]], ink("line"), 1);
  ctx.beginPath();
  ctx.arc(w / 2, h / 2, unit, 0, 2 * Math.PI);
  ctx.strokeStyle = ink("soft");
  ctx.lineWidth = 1.5;
  ctx.stroke();
  ctx.fillStyle = ink("soft");
  ctx.textAlign = "left";
  ctx.fillText("1", w / 2 + unit + 3, h / 2 - 3);
  for (const { re, im } of multipliers) {
    const out = Math.hypot(re, im) >= 1, p = at(re, im);
    disc(ctx, p, 5, out ? ink("bad") : ink("good"), ink("card"));
  }
}

// Viridis, by nine of its colours: even steps of brightness, for every eye.
const VIRIDIS = ["440154", "472d7b", "3b528b", "2c728e", "21918c", "28ae80", "5ec962", "addc30", "fde725"].map(
  (hex) => [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16)),
);
function shade(share) {
  const s = Math.min(1, Math.max(0, share)) * (VIRIDIS.length - 1), i = Math.min(VIRIDIS.length - 2, Math.floor(s));
  return VIRIDIS[i].map((value, k) => Math.round(value + (VIRIDIS[i + 1][k] - value) * (s - i)));
}

// `cells`: by node [column, row] a colour and whether it is hatched, coarse ones first; `x`, `y`: axes
// with from, to, label; `last`: the last node's number, or that of each axis; `dot`: values there.
// `held` keeps the cells' picture while they stay what they are.
function drawGrid(canvas, { last, cells, x, y, dot, cross, held }) {
  const { ctx, w, h } = sheet(canvas), box = { left: 54, right: w - 10, top: 8, bottom: h - 38 };
  const [lastX, lastY] = [last].flat().length > 1 ? last : [last, last];
  const wide = (box.right - box.left) / (lastX + 1), high = (box.bottom - box.top) / (lastY + 1);
  const size = [box.right - box.left, box.bottom - box.top, window.devicePixelRatio || 1, ink("ground")].join();
  if (held.cells !== cells || held.size !== size) {
    Object.assign(held, { cells, size, picture: document.createElement("canvas") });
    drawCells(held.picture, [box.right - box.left, box.bottom - box.top], [wide, high], cells);
  }
  ctx.drawImage(held.picture, box.left, box.top, box.right - box.left, box.bottom - box.top);
  const X = (value) => box.left + wide * (0.5 + ((value - x.from) / (x.to - x.from)) * lastX);
  const Y = (value) => box.bottom - high * (0.5 + ((value - y.from) / (y.to - y.from)) * lastY);
  ctx.fillStyle = ink("soft");
  ctx.textAlign = "center";
  for (const v of ticks(x, w < 420 ? 4 : 6)) {
    line(ctx, [[X(v), box.bottom], [X(v), box.bottom + 4]], ink("soft"), 1);
    ctx.fillText(v, X(v), box.bottom + 16);
  }
  ctx.fillText(x.label, (box.left + box.right) / 2, h - 6);
  ctx.textAlign = "right";
  for (const v of ticks(y, 6)) {
    line(ctx, [[box.left - 4, Y(v)], [box.left, Y(v)]], ink("soft"), 1);
    ctx.fillText(v, box.left - 6, Y(v) + 4);
  }
  ctx.save();
  ctx.translate(12, (box.top + box.bottom) / 2);
  ctx.rotate(-Math.PI / 2);
  ctx.textAlign = "center";
  ctx.fillText(y.label, 0, 0);
  ctx.restore();
  if (dot) disc(ctx, [X(dot[0]), Y(dot[1])], 8, "#ffffff", "#000000");
  if (dot) disc(ctx, [X(dot[0]), Y(dot[1])], 4, "#d55e00");
  if (cross) {
    const [cx, cy] = [X(cross[0]), Y(cross[1])];
    for (const [color, width] of [["#ffffff", 4], ["#000000", 1.6]]) {
      line(ctx, [[cx - 8, cy], [cx + 8, cy]], color, width);
      line(ctx, [[cx, cy - 8], [cx, cy + 8]], color, width);
    }
  }
  const value = (axis, share) => axis.from + (axis.to - axis.from) * Math.min(1, Math.max(0, share));
  return ([px, py]) => [
    value(x, ((px - box.left) / wide - 0.5) / lastX),
    value(y, ((box.bottom - py) / high - 0.5) / lastY),
  ];
}

function drawCells(canvas, [w, h], [wide, high], cells) {
  const dense = window.devicePixelRatio || 1, ctx = canvas.getContext("2d");
  canvas.width = Math.round(w * dense);
  canvas.height = Math.round(h * dense);
  ctx.scale(dense, dense);
  ctx.fillStyle = ink("ground");
  ctx.fillRect(0, 0, w, h);
  for (const { node: [c, r], stride, color, hatched } of cells) {
    // A coarse cell is drawn around its node, until finer ones lie over it.
    const shift = (stride - 1) / 2, x0 = (c - shift) * wide, y1 = h - (r - shift) * high;
    ctx.fillStyle = color;
    ctx.fillRect(Math.floor(x0), Math.floor(y1 - stride * high), Math.ceil(stride * wide) + 1, Math.ceil(stride * high) + 1);
    if (hatched) line(ctx, [[x0, y1], [x0 + stride * wide, y1 - stride * high]], ink("card"), 1);
  }
}

function ticks({ from, to }, about) {
  const rough = (to - from) / about, unit = 10 ** Math.floor(Math.log10(rough));
  const every = [1, 2, 5, 10].map((k) => k * unit).find((step) => step >= rough), found = [];
  for (let i = Math.ceil(from / every - 1e-9); i * every <= to + 1e-9 * every; i++) found.push(+(i * every).toPrecision(8));
  return found;
}
