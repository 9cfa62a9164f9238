// Playing, stepping, keys.
const calm = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
// Few enough frames a second that each one's sentence is seen with its picture.
const rate = () => Math.min(Math.max(n / 60, 5), 8) * Number($("speed").value) / 1000; // frames a millisecond
let playing = false, since = 0;

function show(i) {
  now = Math.min(Math.max(i, 0), n - 1);
  $("scrub").value = now;
  showFacts(); tell(playing); drawPlan(); drawSpace(); drawCursors();
}

function pause() {
  playing = false;
  $("play").textContent = "Play";
  tell(false);
}

function play() {
  if (n < 2) return;
  playing = true; since = performance.now();
  $("play").textContent = "Pause";
  if (now === n - 1) show(0);
  requestAnimationFrame(tick);
}

function tick(time) {
  if (!playing) return;
  const steps = Math.floor((time - since) * rate());
  if (steps > 0) { since += steps / rate(); show(now + steps); }
  if (now === n - 1) pause(); else requestAnimationFrame(tick);
}

function go(i) {
  if (playing) pause();
  show(i);
}

// Keys mean the player where it has the focus, or where it is in view and nothing else has the focus.
function meant(target) {
  if (target.closest("#player")) return true;
  const box = $("plan").getBoundingClientRect();
  return target === document.body && box.bottom > 0 && box.top < window.innerHeight;
}

function onKey(e) {
  if (e.ctrlKey || e.metaKey || e.altKey || !meant(e.target) || e.target.tagName === "SELECT") return;
  const onButton = e.target.closest("button, summary"), ways = { ArrowLeft: now - 1, ArrowRight: now + 1, Home: 0, End: n - 1 };
  if (e.key === " " && !onButton) { e.preventDefault(); if (playing) pause(); else play(); }
  if (e.key in ways) { e.preventDefault(); go(ways[e.key]); }
}

// A window that is closed or hidden may have no width: there is nothing to draw on then.
function redraw() {
  if (!$("plan").clientWidth) return;
  readColours(); shapePlan(); renewLayers(); show(now);
}

function start() {
  $("scrub").max = n - 1;
  $("scrub").addEventListener("input", (e) => go(Number(e.target.value)));
  $("play").addEventListener("click", () => { if (playing) pause(); else play(); });
  $("back").addEventListener("click", () => go(now - 1));
  $("forth").addEventListener("click", () => go(now + 1));
  for (const id of ["play", "back", "forth", "scrub", "speed"]) $(id).disabled = n < 2;
  document.addEventListener("keydown", onKey);
  listenCharts(go); listenSpace(); describeCharts();
  window.addEventListener("resize", redraw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  redraw();
  if (!calm) play();
}

if (n) start();
