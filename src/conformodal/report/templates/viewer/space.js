// The trajectory and the boxes in three dimensions; it turns and zooms by pointer and by keys.
const turn = { yaw: -0.7, tilt: 0.55, zoom: 1 };

function drawSpace() {
  const [g, w, h] = fit($("space")), f = frames[now];
  const middle = range.map((r) => (r[0] + r[1]) / 2), [a, b, up] = [...data.axes, data.up];
  const [cy, sy, ct, st] = [Math.cos(turn.yaw), Math.sin(turn.yaw), Math.cos(turn.tilt), Math.sin(turn.tilt)];
  const seen = (p) => {
    const [x, y, z] = [p[a] - middle[a], p[b] - middle[b], p[up] - middle[up]], [u, v] = [cy * x - sy * y, sy * x + cy * y];
    return [u, -(ct * z + st * v)];
  };
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => seen([0, 1, 2].map((k) => range[k][(i >> k) & 1])));
  const most = (k) => Math.max(...corners.map((c) => Math.abs(c[k])), 1e-9);
  const scale = turn.zoom * Math.min(0.46 * w / most(0), 0.46 * h / most(1));
  const at = (p) => { const [u, v] = seen(p); return [w / 2 + scale * u, h / 2 + scale * v]; };
  g.globalAlpha = 0.35; polyline(g, along(frames, (one) => at(one.p)), colours.answer, 1); g.globalAlpha = 1;
  if (data.truth) polyline(g, along(frames, (one) => one.truth && at(one.truth)), colours.ink, 1, [3, 4]);
  if (!f.whole) drawCuboids(g, f.bx, colours["region-line"], at);
  drawCuboids(g, f.pb || [], colours.answer, at);
  polyline(g, along(frames.slice(0, now + 1), (one) => at(one.p)), colours.answer, 2);
  mark(g, at(f.p), colours.answer, "dot");
  if (f.truth) mark(g, at(f.truth), colours.ink, "cross");
  if (f.whole) plate(g, noBox(f), w / 2, 28);
}

function drawCuboids(g, boxes, colour, at) {
  g.strokeStyle = colour; g.lineWidth = 1.4;
  for (const box of boxes) {
    const e = [0, 1, 2].map((k) => ends(box[k], k));
    const corner = (i) => at([e[0][i & 1], e[1][(i >> 1) & 1], e[2][(i >> 2) & 1]]);
    g.beginPath();
    for (let i = 0; i < 8; i++) for (const bit of [1, 2, 4]) if (!(i & bit)) { g.moveTo(...corner(i)); g.lineTo(...corner(i | bit)); }
    g.stroke();
  }
}

function turnBy(yaw, tilt, zoom) {
  turn.yaw += yaw; turn.tilt = Math.min(Math.max(turn.tilt + tilt, -1.5), 1.5);
  turn.zoom = Math.min(Math.max(turn.zoom * zoom, 0.2), 50);
  drawSpace();
}

function listenSpace() {
  const canvas = $("space"), ways = { a: [-0.1, 0, 1], d: [0.1, 0, 1], w: [0, 0.1, 1], s: [0, -0.1, 1] };
  Object.assign(ways, { "+": [0, 0, 1.2], "=": [0, 0, 1.2], "-": [0, 0, 1 / 1.2] });
  canvas.addEventListener("pointerdown", (e) => canvas.setPointerCapture(e.pointerId));
  canvas.addEventListener("pointermove", (e) => { if (e.buttons & 1) turnBy(e.movementX / 150, e.movementY / 150, 1); });
  $("turning").addEventListener("keydown", (e) => {
    const way = ways[e.key.toLowerCase()];
    if (!way || e.ctrlKey || e.metaKey || e.altKey) return;
    e.preventDefault(); e.stopPropagation();
    turnBy(...way);
  });
  for (const [id, zoom] of [["nearer", 1.25], ["further", 0.8]]) $(id).addEventListener("click", () => turnBy(0, 0, zoom));
}
