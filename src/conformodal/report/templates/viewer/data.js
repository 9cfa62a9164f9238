// What is shown, which frame is shown now, and the ranges that everything is drawn in.
const data = JSON.parse(document.getElementById("viewer-data").textContent);
const frames = data.frames, n = frames.length;
const $ = (id) => document.getElementById(id);
const axisNames = ["x", "y", "z"];
const t0 = n ? frames[0].t : 0, tEnd = n > 1 ? frames[n - 1].t : t0 + 1;
let now = 0;

const isUnknown = (f) => f.ev === "unknown";

// All paths and walls, and boxes unless they lie far outside: one far box would make all else small.
const range = [0, 1, 2].map((a) => {
  let low = Infinity, high = -Infinity;
  const take = (v) => { low = Math.min(low, v); high = Math.max(high, v); };
  for (const f of frames) for (const p of [f.p, f.truth]) if (p) take(p[a]);
  if (a < 2) for (const wall of data.walls) for (const end of wall) take(end[a]);
  const reach = 0.5 * (high - low), [least, most] = [low - reach, high + reach];
  for (const f of frames) for (const part of f.iv[a]) for (const e of part) if (e !== null && e >= least && e <= most) take(e);
  const margin = Math.max(0.06 * (high - low), 1e-3);
  return [low - margin, high + margin];
});

// An interval without a bound is drawn over all that is shown.
const ends = (part, a) => [part[0] === null ? range[a][0] : part[0], part[1] === null ? range[a][1] : part[1]];
