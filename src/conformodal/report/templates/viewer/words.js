// The frame in words: a sentence to see, the same sentence to hear, and the numbers.
const HEARD_EVERY = 6000, SETTLED = 400; // milliseconds
const sources = { softmax: "softmax alone, landmarks not looked for", global: "the image as a whole", unmatched: "the image as a whole, no landmarks trusted", landmarks: "the image and landmarks", disturbed: "a blurred, dark, bright or noisy image", weak: "the image and few landmarks" };
const said = { heard: -Infinity, waiting: null };

// The sentence is of the frame that is drawn, which it names. While it plays, not every one is called out.
function tell(playing) {
  const time = performance.now(), sentence = `Frame ${now + 1} of ${n}. ${frames[now].say}`;
  const hear = () => { said.heard = performance.now(); $("heard").textContent = sentence; };
  $("seen").textContent = sentence;
  clearTimeout(said.waiting);
  if (!playing) said.waiting = setTimeout(hear, SETTLED);
  else if (time - said.heard >= HEARD_EVERY) hear();
}

const p2 = (p) => (p > 0.995 ? "1" : p < 0.01 ? "< 0.01" : p.toFixed(2));
const p3 = (p) => (p < 0.1 ? p.toPrecision(1) : p.toFixed(2));

const placesOf = (boxes) => `${boxes.length}${boxes.length && boxes[0][3] != null ? ` (${boxes.slice(0, 5).map((box) => p2(box[3])).join(", ")})` : ""}`;

function facts(f) {
  const list = (p) => p.map((v) => v.toFixed(3)).join(", ");
  const rows = [[`chosen position (${data.unit})`, list(f.p)]];
  if (f.truth) rows.push([`true position (${data.unit})`, list(f.truth)], ["error", `${f.err.toFixed(4)} ${data.unit}, ${f.deg.toFixed(2)} degrees`]);
  rows.push(["places of the image", f.whole ? "anywhere" : placesOf(f.bx)]);
  if (f.pb) rows.push(["places after motion", placesOf(f.pb)]);
  if (f.truth) rows.push(["truth in the region", f.held ? "yes" : "no"]);
  if (f.kp != null) rows.push(["known place?", isUnknown(f) ? `no, p = ${p3(f.kp)}` : `yes, p = ${p3(f.kp)}`]);
  if (f.ev && !isUnknown(f)) rows.push(["region from", sources[f.ev] || f.ev]);
  const motion = f.m === "first" ? "none, the first frame" : f.m.replaceAll("_", " ");
  const unusable = ["lost", "too_few_corners", "inconsistent"].includes(f.m);
  rows.push(["motion", `${unusable ? "not reliable: " : ""}${motion}`]);
  if (f.pp != null) rows.push(["most probable place", `p = ${p3(f.pp)} when the frame came`]);
  return rows;
}

function showFacts() {
  const f = frames[now], where = `frame ${now + 1} of ${n}, ${(f.t - t0).toFixed(2)} s`;
  $("label").textContent = `${f.n} (${where})`;
  $("scrub").setAttribute("aria-valuetext", where);
  $("words").replaceChildren(...facts(f).map(([k, v]) => {
    const row = document.createElement("div"), dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = k; dd.textContent = v;
    row.append(dt, dd);
    return row;
  }));
  $("plan").setAttribute("aria-label", `Plan of frame ${now + 1}. ${f.say}`);
  const image = $("frame");
  if (image && f.img) image.src = `data:image/jpeg;base64,${f.img}`;
  if (image) image.hidden = !f.img;
}
