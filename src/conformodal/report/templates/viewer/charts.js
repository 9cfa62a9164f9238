// Everything over time. What does not change with the frame is drawn once, onto a layer of its own.
const LEFT = 56, BOTTOM = 8, TOP = 8, RIGHT = 6;
const layers = new Map();
const shortly = (v) => String(Number(v.toPrecision(3)));

function timeAxis(w) {
  return (t) => LEFT + (w - LEFT - RIGHT) * (t - t0) / (tEnd - t0 || 1);
}

// Errors of two methods differ in size: beside the classical regressor they are on a scale of powers of ten.
function errorChart() {
  const values = frames.flatMap((f) => [f.err, f.cerr]).filter((v) => v > 0), high = Math.max(1e-9, ...values);
  const floor = Math.max(Math.min(...values, high), high * 1e-5), by = data.classical ? (v) => Math.log10(Math.max(v, floor)) : (v) => v;
  const line = (key, colour, width, dash) => (g, x, y) => polyline(g, along(frames, (f) => (f[key] == null ? null : [x(f.t), y(by(f[key]))])), colour, width, dash);
  const draw = (g, x, y) => { line("cerr", colours.classical, 1.2, [2, 3])(g, x, y); line("err", colours.answer, 1.5)(g, x, y); };
  return data.classical ? { id: "error", low: Math.floor(by(floor)), high: by(high), draw, number: (v) => shortly(10 ** v) } : { id: "error", low: 0, high, draw };
}

function charts() {
  const most = (key) => Math.max(1e-9, ...frames.map((f) => f[key] || 0));
  const line = (key) => (g, x, y) => polyline(g, along(frames, (f) => (f[key] == null ? null : [x(f.t), y(f[key])])), colours.answer, 1.5);
  const least = Math.floor(Math.log10(Math.min(data.level || 0.1, 0.1, ...frames.map((f) => f.kp || 1))) - 0.1);
  return [
    ...axisNames.map((name, a) => ({ id: `band-${name}`, low: range[a][0], high: range[a][1], draw: bands(a) })),
    // p-values on a scale of powers of ten too: what matters is how small they are
    { id: "known", low: least, high: 0, draw: pValues, number: (v) => String(10 ** v) },
    { id: "size", low: 0, high: most("size"), draw: line("size") },
    errorChart(),
    { id: "angle", low: 0, high: most("deg"), draw: line("deg") },
  ].filter((chart) => $(chart.id));
}

const bands = (a) => (g, x, y) => {
  const half = data.step / 2;
  g.fillStyle = colours.region;
  for (const f of frames) for (const part of f.iv[a]) {
    g.globalAlpha = f.whole ? 0.25 : 0.6;
    const [low, high] = ends(part, a);
    g.fillRect(x(f.t - half), y(high), Math.max(x(f.t + half) - x(f.t - half), 1), Math.max(y(low) - y(high), 1));
  }
  g.globalAlpha = 1; g.fillStyle = colours.classical;
  for (const f of frames) if (f.classical) g.fillRect(x(f.t) - 1, y(f.classical[a]) - 1, 2, 2);
  polyline(g, along(frames, (f) => [x(f.t), y(f.p[a])]), colours.answer, 1.5);
  if (data.truth) polyline(g, along(frames, (f) => f.truth && [x(f.t), y(f.truth[a])]), colours.ink, 1, [3, 4]);
};

// Frames of unknown places are crosses, the others dots.
function pValues(g, x, y) {
  for (const f of frames) if (f.kp) {
    const [u, v] = [x(f.t), y(Math.log10(f.kp))];
    if (!isUnknown(f)) { g.fillStyle = colours.answer; g.fillRect(u - 1.5, v - 1.5, 3, 3); continue; }
    polyline(g, [[u - 4, v - 4], [u + 4, v + 4]], colours.classical, 1.8); polyline(g, [[u - 4, v + 4], [u + 4, v - 4]], colours.classical, 1.8);
  }
  if (data.level) polyline(g, [[x(t0), y(Math.log10(data.level))], [x(tEnd), y(Math.log10(data.level))]], colours.ink, 1, [3, 4]);
}

function layerOf({ id, low, high, draw, number = shortly }) {
  const [g, w, h] = fit($(id)), x = timeAxis(w), y = (v) => h - BOTTOM - (h - BOTTOM - TOP) * (v - low) / (high - low || 1);
  say(g, number(high), LEFT - 6, TOP + 9, "right"); say(g, number(low), LEFT - 6, h - BOTTOM, "right");
  g.strokeStyle = colours.line; g.lineWidth = 1; g.strokeRect(LEFT, TOP - 4, w - LEFT - RIGHT, h - BOTTOM - TOP + 8);
  g.save(); g.beginPath(); g.rect(LEFT, TOP - 4, w - LEFT - RIGHT, h - BOTTOM - TOP + 8); g.clip();
  draw(g, x, y);
  g.restore();
  const layer = document.createElement("canvas");
  [layer.width, layer.height] = [$(id).width, $(id).height];
  layer.getContext("2d").drawImage($(id), 0, 0);
  return layer;
}

function renewLayers() {
  layers.clear();
  for (const chart of charts()) layers.set(chart.id, layerOf(chart));
}

function drawCursors() {
  for (const [id, layer] of layers) if (layer.width && layer.height) {
    const [g, w, h] = fit($(id)), x = timeAxis(w)(frames[now].t);
    g.drawImage(layer, 0, 0, w, h);
    polyline(g, [[x, TOP - 4], [x, h - BOTTOM + 4]], colours.cursor, 2);
  }
}

// What a chart shows, in words, for those who do not see it.
function describeCharts() {
  const spans = { known: "kp", size: "size", error: "err", angle: "deg" };
  for (const { id } of charts()) {
    const a = axisNames.indexOf(id.slice(-1)), values = frames.map((f) => (spans[id] ? f[spans[id]] : f.p[a])).filter((v) => v != null).sort((u, v) => u - v);
    const what = values.length ? `from ${shortly(values[0])} to ${shortly(values[values.length - 1])}, median ${shortly(values[values.length >> 1])}` : "no values";
    $(id).setAttribute("aria-label", `${$(id).dataset.what} over ${(tEnd - t0).toFixed(1)} seconds: ${what}`);
  }
}

function listenCharts(go) {
  for (const canvas of document.querySelectorAll("canvas.chart")) canvas.addEventListener("click", (e) => {
    const t = t0 + (e.offsetX - LEFT) / (canvas.clientWidth - LEFT - RIGHT) * (tEnd - t0);
    go(frames.reduce((best, f, i) => (Math.abs(f.t - t) < Math.abs(frames[best].t - t) ? i : best), 0));
  });
}
