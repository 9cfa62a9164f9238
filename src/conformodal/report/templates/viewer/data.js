// What is shown, which frame is shown now, and the ranges that everything is drawn in.
const data = JSON.parse(document.getElementById("viewer-data").textContent);
const frames = data.frames, n = frames.length;
const $ = (id) => document.getElementById(id);
const axisNames = ["x", "y", "z"];
const t0 = n ? frames[0].t : 0, tEnd = n > 1 ? frames[n - 1].t : t0 + 1;
let now = 0;

// Points of frames for a line, which is broken between recordings.
const along = (some, point) => some.flatMap((f, i) => (i && f.rec !== some[i - 1].rec ? [null, point(f)] : [point(f)]));

const isUnknown = (f) => f.ev === "unknown";

// The run's paths, the walls, and the boxes but a hundredth at either end: one far box would make all else small.
const range = [0, 1, 2].map((a) => {
  const ends = frames.flatMap((f) => f.iv[a].flat()).filter((e) => e !== null).sort((u, v) => u - v), cut = Math.floor(ends.length / 100);
  const all = [...frames.map((f) => f.p[a]), ...frames.filter((f) => f.truth).map((f) => f.truth[a]), ...ends.slice(cut, ends.length - cut)];
  if (a < 2) for (const wall of data.walls) all.push(wall[0][a], wall[1][a]);
  const [low, high] = all.reduce(([l, h], v) => [Math.min(l, v), Math.max(h, v)], [Infinity, -Infinity]), margin = Math.max(0.06 * (high - low), 1e-3);
  return [low - margin, high + margin];
});

// A round length, a third of the plan at most.
const widest = Math.max(...data.axes.map((a) => range[a][1] - range[a][0]));
const ruler = [0.01, 0.02, 0.05].concat(...[0.1, 1, 10, 100, 1000].map((power) => [power, 2 * power, 5 * power])).findLast((length) => length <= widest / 3) || 0.01;

// An interval without a bound is drawn over all that is shown.
const ends = (part, a) => [part[0] === null ? range[a][0] : part[0], part[1] === null ? range[a][1] : part[1]];
