"use strict";
(() => {
  const data = JSON.parse(document.getElementById("viewer-data").textContent);
  const frames = data.frames, n = frames.length;
  const $ = (id) => document.getElementById(id);
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const axisNames = ["x", "y", "z"];
  let now = 0, playing = null, turn = { yaw: -0.7, tilt: 0.55, zoom: 1 };
  const t0 = n ? frames[0].t : 0;

  // ranges that everything is drawn in
  const range = [0, 1, 2].map((a) => {
    let low = Infinity, high = -Infinity;
    for (const f of frames) for (const p of [f.p, f.truth]) if (p) { low = Math.min(low, p[a]); high = Math.max(high, p[a]); }
    const margin = Math.max(0.15 * (high - low), 1e-3);
    return [low - margin, high + margin];
  });
  // the whole line is drawn over all that is shown
  const ends = (part, a) => [part[0] === null ? range[a][0] : part[0], part[1] === null ? range[a][1] : part[1]];

  function fit(canvas) {
    const scale = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    if (canvas.width !== Math.round(w * scale) || canvas.height !== Math.round(h * scale)) {
      canvas.width = Math.round(w * scale); canvas.height = Math.round(h * scale);
    }
    const g = canvas.getContext("2d");
    g.setTransform(scale, 0, 0, scale, 0, 0);
    g.clearRect(0, 0, w, h);
    g.font = "12px system-ui, sans-serif";
    return [g, w, h];
  }

  function polyline(g, points, colour, width, dash) {
    g.beginPath(); g.strokeStyle = colour; g.lineWidth = width; g.setLineDash(dash || []);
    points.forEach((p, i) => { if (p) (i && points[i - 1] ? g.lineTo(p[0], p[1]) : g.moveTo(p[0], p[1])); });
    g.stroke(); g.setLineDash([]);
  }

  function mark(g, p, colour, shape) {
    g.beginPath(); g.strokeStyle = colour; g.fillStyle = colour; g.lineWidth = 2;
    if (shape === "dot") { g.arc(p[0], p[1], 5, 0, 7); g.fill(); return; }
    if (shape === "square") { g.strokeRect(p[0] - 5, p[1] - 5, 10, 10); return; }
    g.moveTo(p[0] - 6, p[1]); g.lineTo(p[0] + 6, p[1]); g.moveTo(p[0], p[1] - 6); g.lineTo(p[0], p[1] + 6); g.stroke();
  }

  // a frame that shows no place that is known, and one whose region holds every position
  const unknown = (f) => f.ev === "unknown";
  function everywhere(g, w) {
    g.fillStyle = css("--ink"); g.textAlign = "center";
    g.fillText(unknown(frames[now]) ? "I do not know: the region is the whole space" : "the region is the whole space", w / 2, 30);
    g.textAlign = "left";
  }

  // where the camera looks, from its quaternion wxyz: the third column of the rotation
  const ahead = (q) => [2 * (q[1] * q[3] + q[0] * q[2]), 2 * (q[2] * q[3] - q[0] * q[1]), 1 - 2 * (q[1] ** 2 + q[2] ** 2)];

  function plan() {
    const [g, w, h] = fit($("plan")), [a, b] = data.axes, f = frames[now], pad = 30;
    const scale = Math.min((w - 2 * pad) / (range[a][1] - range[a][0]), (h - 2 * pad) / (range[b][1] - range[b][0]));
    const at = (p) => [pad + (p[a] - range[a][0]) * scale, h - pad - (p[b] - range[b][0]) * scale];
    g.fillStyle = css("--region"); g.globalAlpha = f.whole ? 0.15 : 0.45;
    if (f.whole) g.fillRect(0, 0, w, h);
    else for (const u of f.iv[a]) for (const v of f.iv[b]) {
      const p = [0, 0, 0], q = [0, 0, 0];
      [p[a], q[a]] = ends(u, a); [p[b], q[b]] = ends(v, b);
      const [x0, y0] = at(p), [x1, y1] = at(q);
      g.fillRect(x0, y1, Math.max(x1 - x0, 2), Math.max(y0 - y1, 2));
    }
    g.globalAlpha = 1;
    polyline(g, frames.map((f) => at(f.p)), css("--answer"), 1.5);
    if (data.truth) polyline(g, frames.map((f) => f.truth && at(f.truth)), css("--ink"), 1, [4, 3]);
    const here = at(f.p), way = ahead(f.q), size = Math.hypot(way[a], way[b]) || 1;
    polyline(g, [here, [here[0] + 22 * way[a] / size, here[1] - 22 * way[b] / size]], css("--answer"), 3);
    mark(g, here, css("--answer"), "dot");
    if (f.classical) mark(g, at(f.classical), css("--classical"), "square");
    if (f.truth) mark(g, at(f.truth), css("--ink"), "cross");
    if (f.whole) everywhere(g, w);
    g.fillStyle = css("--faint");
    g.fillText(`${axisNames[a]} (m) \u2192`, w - 60, h - 8); g.fillText(`${axisNames[b]} (m) \u2191`, 4, 14);
    g.fillRect(pad, h - 8, scale * data.ruler, 2); g.fillText(`${data.ruler} m`, pad, h - 12);
  }

  function space() {
    const [g, w, h] = fit($("space")), f = frames[now];
    const middle = range.map((r) => (r[0] + r[1]) / 2), span = Math.hypot(...range.map((r) => r[1] - r[0]));
    const scale = turn.zoom * 0.9 * Math.min(w, h) / span;
    const [cy, sy, ct, st] = [Math.cos(turn.yaw), Math.sin(turn.yaw), Math.cos(turn.tilt), Math.sin(turn.tilt)];
    const at = (p) => {
      const [x, y, z] = [p[data.axes[0]] - middle[data.axes[0]], p[data.axes[1]] - middle[data.axes[1]], p[data.up] - middle[data.up]];
      const [u, v] = [cy * x - sy * y, sy * x + cy * y];
      return [w / 2 + scale * u, h / 2 - scale * (ct * z + st * v)];
    };
    g.strokeStyle = css("--region"); g.lineWidth = 1.2;
    let boxes = 0;
    if (!f.whole) for (const u of f.iv[0]) for (const v of f.iv[1]) for (const s of f.iv[2]) {
      if (++boxes > 64) continue;
      const e = [ends(u, 0), ends(v, 1), ends(s, 2)];
      const corner = (i) => at([e[0][i & 1], e[1][(i >> 1) & 1], e[2][(i >> 2) & 1]]);
      g.beginPath();
      for (let i = 0; i < 8; i++) for (const bit of [1, 2, 4]) if (!(i & bit)) { g.moveTo(...corner(i)); g.lineTo(...corner(i | bit)); }
      g.stroke();
    }
    polyline(g, frames.map((f) => at(f.p)), css("--answer"), 1.5);
    if (data.truth) polyline(g, frames.map((f) => f.truth && at(f.truth)), css("--ink"), 1, [4, 3]);
    mark(g, at(f.p), css("--answer"), "dot");
    if (f.truth) mark(g, at(f.truth), css("--ink"), "cross");
    if (f.whole) everywhere(g, w);
    g.fillStyle = css("--faint"); g.fillText("drag to turn, wheel to zoom", 6, h - 8);
  }

  function chart(id, label, low, high, draw, say = (v) => v.toPrecision(3)) {
    const canvas = $(id);
    if (!canvas) return;
    const [g, w, h] = fit(canvas), left = 48, bottom = 16, end = n > 1 ? frames[n - 1].t : t0 + 1;
    const x = (t) => left + (w - left - 6) * (t - t0) / (end - t0 || 1), y = (v) => h - bottom - (h - bottom - 6) * (v - low) / (high - low || 1);
    g.fillStyle = css("--faint"); g.textAlign = "right";
    g.fillText(say(high), left - 4, 14); g.fillText(say(low), left - 4, h - bottom);
    g.textAlign = "left"; g.fillText(label, left + 4, 14);
    g.save(); g.beginPath(); g.rect(left, 0, w - left, h - bottom + 1); g.clip();
    draw(g, x, y);
    g.restore();
    g.strokeStyle = css("--faint"); g.lineWidth = 1; g.strokeRect(left, 2, w - left - 4, h - bottom - 2);
    polyline(g, [[x(frames[now].t), 2], [x(frames[now].t), h - bottom]], css("--cursor"), 2);
  }

  function charts() {
    const half = n > 1 ? (frames[n - 1].t - t0) / (n - 1) / 2 : 0.5;
    axisNames.forEach((name, a) => chart(`band-${name}`, `${name} (m)`, range[a][0], range[a][1], (g, x, y) => {
      g.fillStyle = css("--region");
      for (const f of frames) for (const part of f.iv[a]) {
        g.globalAlpha = f.whole ? 0.2 : 0.5;
        const [low, high] = ends(part, a);
        g.fillRect(x(f.t - half), y(high), Math.max(x(f.t + half) - x(f.t - half), 1), Math.max(y(low) - y(high), 1));
      }
      g.globalAlpha = 1;
      if (data.classical) { g.fillStyle = css("--classical"); for (const f of frames) if (f.classical) g.fillRect(x(f.t) - 1, y(f.classical[a]) - 1, 2, 2); }
      polyline(g, frames.map((f) => [x(f.t), y(f.p[a])]), css("--answer"), 1.5);
      if (data.truth) polyline(g, frames.map((f) => f.truth && [x(f.t), y(f.truth[a])]), css("--ink"), 1, [4, 3]);
    }));
    const most = (key) => Math.max(...frames.map((f) => f[key] || 0), 1e-9);
    const line = (key) => (g, x, y) => polyline(g, frames.map((f) => (f[key] === null || f[key] === undefined ? null : [x(f.t), y(f[key])])), css("--answer"), 1.5);
    // p-values on a scale of powers of ten: what matters is how small they are
    const power = Math.log10, smallest = Math.min(data.level || 0.1, 0.1, ...frames.map((f) => f.kp || 1)), least = Math.floor(power(smallest) - 0.1);
    chart("known", "known place? (p)", least, 0, (g, x, y) => {
      for (const f of frames) if (f.kp) {
        g.fillStyle = css(unknown(f) ? "--classical" : "--answer");
        g.fillRect(x(f.t) - 1.5, y(power(f.kp)) - 1.5, 3, 3);
      }
      if (data.level) polyline(g, [[x(t0), y(power(data.level))], [x(n > 1 ? frames[n - 1].t : t0 + 1), y(power(data.level))]], css("--ink"), 1, [4, 3]);
    }, (v) => String(10 ** v));
    chart("size", "size of the position's region (m)", 0, most("size"), line("size"));
    chart("error", "position error (m)", 0, Math.max(most("err"), most("cerr")), (g, x, y) => {
      if (data.classical) polyline(g, frames.map((f) => (f.cerr === null ? null : [x(f.t), y(f.cerr)])), css("--classical"), 1, [2, 2]);
      line("err")(g, x, y);
    });
    chart("angle", "orientation error (degrees)", 0, most("deg"), line("deg"));
  }

  const p3 = (p) => (p < 0.1 ? p.toPrecision(1) : p.toFixed(2));
  const sources = { softmax: "softmax alone, landmarks not looked for", unmatched: "softmax, no landmarks trusted", landmarks: "softmax and landmarks" };

  function words() {
    const f = frames[now], list = (p) => p.map((v) => v.toFixed(3)).join(", ");
    $("label").textContent = `${f.n}, ${(f.t - t0).toFixed(2)} s (${now + 1} of ${n} shown)`;
    const counts = f.whole ? "the whole space" : axisNames.map((name, a) => `${name} ${f.iv[a].length}`).join(", ");
    const rows = [["chosen position (m)", list(f.p)], ["intervals", counts], ["motion", f.ok || unknown(f) ? f.m : `not reliable: ${f.m}`]];
    if (f.kp != null) rows.push(["known place?", unknown(f) ? `p = ${p3(f.kp)}. I do not know: the region is the whole space` : `p = ${p3(f.kp)}`]);
    if (f.ev && !unknown(f)) rows.push(["region from", sources[f.ev] || f.ev]);
    if (f.truth) rows.splice(1, 0, ["true position (m)", list(f.truth)], ["error", `${f.err.toFixed(4)} m, ${f.deg.toFixed(2)} degrees`]);
    if (f.truth) rows.push(["truth in the region (position)", f.held ? "yes" : "no"]);
    $("words").replaceChildren(...rows.flatMap(([k, v]) => {
      const dt = document.createElement("dt"), dd = document.createElement("dd");
      dt.textContent = k; dd.textContent = v;
      return [dt, dd];
    }));
    const image = $("frame");
    if (image) { image.hidden = !f.img; if (f.img) image.src = `data:image/jpeg;base64,${f.img}`; }
  }

  function show(i) {
    now = Math.min(Math.max(i, 0), n - 1);
    $("scrub").value = now;
    words(); plan(); space(); charts();
  }

  function play() {
    $("play").textContent = playing ? "play" : "pause";
    if (playing) { clearInterval(playing); playing = null; return; }
    playing = setInterval(() => show(now + 1 < n ? now + 1 : 0), 80);
  }

  if (!n) return;
  $("scrub").max = n - 1;
  $("scrub").addEventListener("input", (e) => show(Number(e.target.value)));
  $("play").addEventListener("click", play);
  $("back").addEventListener("click", () => show(now - 1));
  $("forth").addEventListener("click", () => show(now + 1));
  document.addEventListener("keydown", (e) => {
    if (e.target.tagName === "INPUT") return;
    if (e.key === "ArrowLeft") show(now - 1);
    if (e.key === "ArrowRight") show(now + 1);
  });
  for (const canvas of document.querySelectorAll("canvas.chart")) canvas.addEventListener("click", (e) => {
    const left = 48, share = (e.offsetX - left) / (canvas.clientWidth - left - 6), t = t0 + share * (frames[n - 1].t - t0);
    show(frames.reduce((best, f, i) => (Math.abs(f.t - t) < Math.abs(frames[best].t - t) ? i : best), 0));
  });
  const canvas = $("space");
  canvas.addEventListener("pointerdown", (e) => canvas.setPointerCapture(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    if (!(e.buttons & 1)) return;
    turn.yaw += e.movementX / 150; turn.tilt = Math.min(Math.max(turn.tilt + e.movementY / 150, -1.5), 1.5);
    space();
  });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); turn.zoom *= Math.exp(-e.deltaY / 500); space(); }, { passive: false });
  window.addEventListener("resize", () => show(now));
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => show(now));
  show(0);
})();
