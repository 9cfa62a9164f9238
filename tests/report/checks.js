// What a page must hold for people who see little, use no pointer, or listen. Every check returns what is wrong, as text.
(() => {
  const shown = (e) => e.checkVisibility({ visibilityProperty: true, opacityProperty: true }) && !e.closest(".hidden");
  const where = (e) => `<${e.tagName.toLowerCase()}${e.id ? ` id=${e.id}` : ""}> ${(e.textContent || "").trim().slice(0, 40)}`;

  // WCAG 2.2: relative luminance and contrast, https://www.w3.org/TR/WCAG22/#dfn-contrast-ratio
  const linear = (c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
  const luminance = ([r, g, b]) => 0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
  const ratio = (a, b) => {
    const [low, high] = [luminance(a), luminance(b)].sort((u, v) => u - v);
    return (high + 0.05) / (low + 0.05);
  };
  // A canvas knows every way to write a colour.
  const painter = Object.assign(document.createElement("canvas"), { width: 1, height: 1 }).getContext("2d", { willReadFrequently: true });
  function rgba(text) {
    painter.clearRect(0, 0, 1, 1);
    painter.fillStyle = text; painter.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = painter.getImageData(0, 0, 1, 1).data;
    return [r, g, b, a / 255];
  }
  const over = (top, below) => [0, 1, 2].map((i) => top[3] * top[i] + (1 - top[3]) * below[i]);
  function ground(element) {
    const layers = [];
    for (let e = element; e; e = e.parentElement) layers.push(rgba(getComputedStyle(e).backgroundColor));
    const dark = matchMedia("(prefers-color-scheme: dark)").matches && getComputedStyle(document.documentElement).colorScheme.includes("dark");
    return layers.reverse().reduce((below, top) => over(top, below), dark ? [18, 18, 18] : [255, 255, 255]);
  }

  function contrast(within = "body") {
    const wrong = [], walker = document.createTreeWalker(document.querySelector(within), NodeFilter.SHOW_TEXT);
    let checked = 0;
    while (walker.nextNode()) {
      const text = walker.currentNode, e = text.parentElement;
      if (!text.textContent.trim() || ["SCRIPT", "STYLE", "NOSCRIPT", "OPTION", "TITLE"].includes(e.tagName) || !shown(e) || e.closest(":disabled")) continue;
      const style = getComputedStyle(e), drawn = e.closest("svg"), below = ground(e);
      const found = ratio(over(rgba(drawn ? style.fill : style.color), below), below), size = parseFloat(style.fontSize);
      const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
      checked++;
      if (found < (large ? 3 : 4.5)) wrong.push(`contrast ${found.toFixed(2)}: ${where(e)}`);
    }
    return checked ? wrong : ["no text was found"];
  }

  // The colours of text and of marks that are drawn on canvases.
  function palette(texts, marks) {
    const style = getComputedStyle(document.documentElement), colour = (name) => rgba(style.getPropertyValue(name).trim());
    const paper = colour("--paper"), least = [...texts.map((name) => [name, 4.5]), ...marks.map((name) => [name, 3])];
    return least.filter(([name, need]) => ratio(colour(name), paper) < need).map(([name]) => `${name} is too pale`);
  }

  function name(e) {
    const by = (e.getAttribute("aria-labelledby") || "").split(/\s+/).map((id) => (document.getElementById(id) || {}).textContent || "").join(" ");
    const labels = e.labels ? [...e.labels].map((l) => l.textContent).join(" ") : "";
    const text = ["BUTTON", "A", "SUMMARY"].includes(e.tagName) ? e.textContent + [...e.querySelectorAll("img[alt]")].map((i) => i.alt).join(" ") : "";
    return (e.getAttribute("aria-label") || by || labels || e.getAttribute("alt") || e.getAttribute("title") || text).trim();
  }
  const focusable = () => [...document.querySelectorAll("a[href], button, input, select, textarea, summary, [tabindex]")].filter((e) => e.tabIndex >= 0 && !e.disabled && shown(e));

  function labels() {
    const named = [...focusable(), ...document.querySelectorAll("[role=img], [role=region], [role=group], img, main canvas")].filter((e) => e.checkVisibility());
    const wrong = named.filter((e) => !name(e) && e.getAttribute("alt") !== "").map((e) => `no name: ${where(e)}`);
    for (const c of document.querySelectorAll("main canvas")) if (c.getAttribute("role") !== "img") wrong.push(`no role: ${where(c)}`);
    for (const s of document.querySelectorAll("svg")) if (!s.closest("[role=img], [aria-hidden=true]")) wrong.push(`neither an image nor hidden: ${where(s)}`);
    const ids = [...document.querySelectorAll("[id]")].filter((e) => !e.closest("svg")).map((e) => e.id);
    for (const id of new Set(ids.filter((one, i) => ids.indexOf(one) !== i))) wrong.push(`id twice: ${id}`);
    for (const e of document.querySelectorAll("[aria-labelledby]")) if (!name(e)) wrong.push(`label is missing: ${where(e)}`);
    return wrong;
  }

  function structure() {
    const wrong = [], levels = [...document.querySelectorAll("h1, h2, h3, h4, h5, h6")].filter((e) => e.checkVisibility()).map((e) => Number(e.tagName[1]));
    if (!document.documentElement.lang) wrong.push("no language");
    if (!document.title.trim()) wrong.push("no title");
    if (levels.filter((l) => l === 1).length !== 1 || levels[0] !== 1) wrong.push(`headings ${levels}`);
    levels.forEach((l, i) => { if (i && l > levels[i - 1] + 1) wrong.push(`heading ${l} follows ${levels[i - 1]}`); });
    for (const one of ["main", "header"]) if (document.querySelectorAll(`body > ${one}, body > * > ${one}`).length !== 1) wrong.push(`not one ${one}`);
    for (const table of document.querySelectorAll("table")) {
      if (!table.querySelector("thead th")) wrong.push(`no header: ${where(table)}`);
      for (const th of table.querySelectorAll("th")) if (!th.scope) wrong.push(`no scope: ${where(th)}`);
      for (const row of table.querySelectorAll("tbody tr")) if (!row.querySelector("th[scope=row]")) wrong.push(`no header: ${where(row)}`);
    }
    return wrong;
  }

  // Nothing is wider than the window but what scrolls in a box of its own, and such a box is reached by keyboard.
  function overflow() {
    const wrong = [], root = document.documentElement;
    if (root.scrollWidth > root.clientWidth) wrong.push(`the page is ${root.scrollWidth} wide in ${root.clientWidth}`);
    const scrolls = (e) => ["auto", "scroll"].includes(getComputedStyle(e).overflowX);
    for (const e of document.querySelectorAll("body *")) {
      if (!shown(e)) continue;
      let box = e.parentElement;
      while (box && !scrolls(box)) box = box.parentElement;
      if (!box && e.getBoundingClientRect().right > root.clientWidth + 1) wrong.push(`beyond the window: ${where(e)}`);
      if (scrolls(e) && e.scrollWidth > e.clientWidth + 1 && e.tabIndex < 0) wrong.push(`scrolls, but not by keyboard: ${where(e)}`);
    }
    return wrong;
  }

  const small = () => [...document.querySelectorAll("button, input, select, summary")].filter(shown)
    .filter((e) => { const box = e.getBoundingClientRect(); return box.width < 24 || box.height < 24; }).map((e) => `small: ${where(e)}`);

  // The element that has the focus: which one, and whether people see that.
  function focus() {
    const e = document.activeElement, style = getComputedStyle(e), ring = rgba(style.outlineColor);
    const seen = style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2 && ratio(over(ring, ground(e.parentElement)), ground(e.parentElement)) >= 3;
    return [focusable().indexOf(e), seen, where(e)];
  }

  window.checks = { contrast, palette, labels, structure, overflow, small, focus, focusable: () => focusable().length };
})();
