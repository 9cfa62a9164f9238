// The plan: training frames, the region's boxes, the chosen path so far, the truth, and where the camera looks.
const LEAST_FRAME = 20; // pixels: a place that is smaller has a frame of this size around it

// Where the camera looks, from its quaternion wxyz: the third column of the rotation.
const ahead = (q) => [2 * (q[1] * q[3] + q[0] * q[2]), 2 * (q[2] * q[3] - q[0] * q[1]), 1 - 2 * (q[1] ** 2 + q[2] ** 2)];

// The plan is as high as its content asks for, within reason.
function shapePlan() {
  const canvas = $("plan"), [a, b] = data.axes, narrow = canvas.clientWidth < 600;
  const wanted = (range[b][1] - range[b][0]) / (range[a][1] - range[a][0]);
  const ratio = Math.min(Math.max(wanted, narrow ? 0.6 : 0.34), narrow ? 1 : 0.56);
  // with the controls, on the first screen of a usual window
  canvas.style.height = `${Math.round(Math.min(canvas.clientWidth * ratio, Math.max(0.45 * window.innerHeight, 280)))}px`;
}

function drawPlan() {
  const [g, w, h] = fit($("plan")), [a, b] = data.axes, f = frames[now], pad = 24;
  const [dx, dy] = [range[a][1] - range[a][0], range[b][1] - range[b][0]];
  const scale = Math.min((w - 2 * pad) / dx, (h - 2 * pad) / dy);
  const [left, low] = [(w - scale * dx) / 2, (h + scale * dy) / 2];
  const at = (p) => [left + (p[a] - range[a][0]) * scale, low - (p[b] - range[b][0]) * scale];
  const point = (u, v) => { const p = [0, 0, 0]; p[a] = u; p[b] = v; return at(p); };
  drawGrid(g, w, h, point, scale);
  for (const wall of data.walls) polyline(g, wall.map(([x, y]) => point(x, y)), colours.faint, 1.5);
  if (f.whole) hatch(g, w, h);
  g.fillStyle = colours.faint;
  for (const p of data.trained) { const [x, y] = at(p); g.fillRect(x - 1, y - 1, 2, 2); }
  g.globalAlpha = 0.35; polyline(g, along(frames, (one) => at(one.p)), colours.answer, 1); g.globalAlpha = 1;
  if (data.truth) polyline(g, along(frames, (one) => one.truth && at(one.truth)), colours.ink, 1, [3, 4]);
  const outside = f.whole ? 0 : drawBoxes(g, w, h, f, point);
  drawPlaces(g, f, point);
  polyline(g, along(frames.slice(0, now + 1), (one) => at(one.p)), colours.answer, 2.5);
  drawCamera(g, at(f.p), ahead(f.q), a, b);
  if (f.classical) mark(g, at(f.classical), colours.classical, "diamond");
  mark(g, at(f.p), colours.answer, "dot");
  if (f.truth) mark(g, at(f.truth), colours.ink, "cross");
  if (f.whole) plate(g, noBox(f), w / 2, 28);
  if (outside) plate(g, `${outside} more beyond this plan`, w / 2, 28);
  drawScale(g, w, h, scale);
}

function drawGrid(g, w, h, point, scale) {
  const step = ruler, [a, b] = data.axes, [x0, y0] = point(0, 0);
  for (let x = x0 % (step * scale); x < w; x += step * scale) polyline(g, [[x, 0], [x, h]], colours.line, 1);
  for (let y = y0 % (step * scale); y < h; y += step * scale) polyline(g, [[0, y], [w, y]], colours.line, 1);
  say(g, `${axisNames[a]} \u2192`, w - 8, h - 8, "right"); say(g, `${axisNames[b]} \u2191`, 8, 18);
}

function drawScale(g, w, h, scale) {
  const long = ruler * scale, [x, y] = [10, h - 10];
  polyline(g, [[x, y - 5], [x, y], [x + long, y], [x + long, y - 5]], colours.ink, 1.5);
  say(g, `${ruler} ${data.unit}`, x + long / 2, y - 6, "center", colours.ink);
}

// A region without a bound fills the plan with lines, which no box has.
function hatch(g, w, h) {
  g.globalAlpha = 0.4;
  for (let x = -h; x < w; x += 14) polyline(g, [[x, h], [x + h, 0]], colours.region, 2);
  g.globalAlpha = 1;
}

// Returns how many boxes lie beyond the plan.
function drawBoxes(g, w, h, f, point) {
  const [a, b] = data.axes;
  let outside = 0;
  for (const box of f.bx) {
    const [p, q] = [ends(box[a], a), ends(box[b], b)], [x0, y1] = point(p[0], q[0]), [x1, y0] = point(p[1], q[1]);
    if (x1 < 0 || x0 > w || y1 < 0 || y0 > h) { outside++; continue; }
    const grow = (low, high) => Math.max(LEAST_FRAME - (high - low), 0) / 2, [mx, my] = [grow(x0, x1), grow(y0, y1)];
    g.fillStyle = colours.region; g.strokeStyle = colours["region-line"];
    g.globalAlpha = 0.55; g.fillRect(x0, y0, Math.max(x1 - x0, 2), Math.max(y1 - y0, 2)); g.globalAlpha = 1;
    g.beginPath(); g.lineWidth = 2; g.roundRect(x0 - mx, y0 - my, x1 - x0 + 2 * mx, y1 - y0 + 2 * my, 4); g.stroke();
    if (f.bx.length > 1 && box[3] != null) say(g, p2(box[3]), (x0 + x1) / 2, y0 - my - 5, "center", colours.ink);
  }
  return outside;
}

// Where the camera may be once the frames before are known.
function drawPlaces(g, f, point) {
  const [a, b] = data.axes;
  g.strokeStyle = colours.answer; g.lineWidth = 2;
  for (const box of f.pb || []) {
    const [p, q] = [ends(box[a], a), ends(box[b], b)], [x0, y1] = point(p[0], q[0]), [x1, y0] = point(p[1], q[1]);
    g.beginPath(); g.roundRect(x0 - 3, y0 - 3, x1 - x0 + 6, y1 - y0 + 6, 4); g.stroke();
  }
}

function drawCamera(g, [x, y], way, a, b) {
  const angle = Math.atan2(-way[b], way[a]), long = 34 * Math.max(Math.hypot(way[a], way[b]), 0.3);
  g.beginPath(); g.moveTo(x, y);
  for (const side of [-0.45, 0.45]) g.lineTo(x + long * Math.cos(angle + side), y + long * Math.sin(angle + side));
  g.closePath();
  g.fillStyle = colours.answer; g.globalAlpha = 0.3; g.fill(); g.globalAlpha = 1;
  g.strokeStyle = colours.answer; g.lineWidth = 1.5; g.stroke();
}
