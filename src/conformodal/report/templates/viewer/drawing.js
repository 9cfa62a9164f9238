// Lines and marks on a canvas, in the page's colours.
let colours = {};

function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["ink", "paper", "faint", "line", "region", "region-line", "answer", "classical", "cursor"])
    colours[name] = style.getPropertyValue(`--${name}`).trim();
}

function fit(canvas) {
  const scale = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * scale) || canvas.height !== Math.round(h * scale)) {
    canvas.width = Math.round(w * scale); canvas.height = Math.round(h * scale);
  }
  const g = canvas.getContext("2d");
  g.setTransform(scale, 0, 0, scale, 0, 0);
  g.clearRect(0, 0, w, h);
  g.font = "13px system-ui, sans-serif";
  g.lineJoin = "round";
  return [g, w, h];
}

function polyline(g, points, colour, width, dash) {
  g.beginPath(); g.strokeStyle = colour; g.lineWidth = width; g.setLineDash(dash || []);
  points.forEach((p, i) => { if (p) (i && points[i - 1] ? g.lineTo(p[0], p[1]) : g.moveTo(p[0], p[1])); });
  g.stroke(); g.setLineDash([]);
}

// Each kind of mark has a shape of its own, so that colour is never needed; a rim keeps it apart from lines below it.
const shapes = {
  dot: (g, x, y) => g.arc(x, y, 5.5, 0, 7),
  diamond: (g, x, y) => { g.moveTo(x, y - 8); g.lineTo(x + 8, y); g.lineTo(x, y + 8); g.lineTo(x - 8, y); g.closePath(); },
  cross: (g, x, y) => { g.moveTo(x - 8, y); g.lineTo(x + 8, y); g.moveTo(x, y - 8); g.lineTo(x, y + 8); },
};

function mark(g, [x, y], colour, shape) {
  for (const [ink, width] of [[colours.paper, 5], [colour, 2.2]]) {
    g.beginPath(); shapes[shape](g, x, y);
    g.strokeStyle = ink; g.fillStyle = ink; g.lineWidth = width; g.stroke();
    if (shape === "dot") g.fill();
  }
}

function say(g, text, x, y, align = "left", colour = colours.faint) {
  g.textAlign = align; g.fillStyle = colour; g.fillText(text, x, y); g.textAlign = "left";
}

// Text that has to be read over lines: on a plate of the page's own colour.
function plate(g, text, x, y) {
  const half = g.measureText(text).width / 2 + 8;
  g.fillStyle = colours.paper; g.fillRect(x - half, y - 17, 2 * half, 25);
  g.strokeStyle = colours["region-line"]; g.lineWidth = 1.5; g.strokeRect(x - half, y - 17, 2 * half, 25);
  say(g, text, x, y, "center", colours.ink);
}

// What is said in a view whose region has no box to draw.
const noBox = (f) => (isUnknown(f) ? "Unknown place: the region is unbounded" : "The region is unbounded");
