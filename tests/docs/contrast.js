// Texts of the page whose colour stands out too little from what is behind them: 4.5 : 1, or 3 : 1 where they are large.
() => {
  const context = Object.assign(document.createElement("canvas"), {width: 1, height: 1})
    .getContext("2d", {willReadFrequently: true});
  const rgba = (colour) => {  // whatever the notation
    context.clearRect(0, 0, 1, 1);
    context.fillStyle = colour;
    context.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = context.getImageData(0, 0, 1, 1).data;
    return [r, g, b, a / 255];
  };
  const over = (top, below) => [0, 1, 2].map((i) => top[i] * top[3] + below[i] * (1 - top[3]));
  const ancestors = (element) => {
    const found = [];
    for (let here = element; here; here = here.parentElement) found.push(here);
    return found;
  };
  const behind = (element) => ancestors(element).reverse()
    .reduce((below, here) => over(rgba(getComputedStyle(here).backgroundColor), below), [255, 255, 255]);
  const luminance = (colour) => {
    const [r, g, b] = colour.map((v) => (v / 255 <= 0.03928 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const found = new Set();
  let n = 0;
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const element = texts.currentNode.parentElement, style = getComputedStyle(element);
    if (!texts.currentNode.data.trim() || !element.checkVisibility({visibilityProperty: true})) continue;
    const opacity = ancestors(element).reduce((all, here) => all * getComputedStyle(here).opacity, 1);
    if (opacity < 0.05 || !element.getBoundingClientRect().width) continue;
    n += 1;
    const colour = rgba(style.color), ground = behind(element);
    colour[3] *= opacity;
    const [light, dark] = [luminance(over(colour, ground)), luminance(ground)].sort((a, b) => b - a);
    const size = parseFloat(style.fontSize), large = size >= 24 || (size >= 18.66 && style.fontWeight >= 700);
    const ratio = (light + 0.05) / (dark + 0.05);
    if (ratio < (large ? 3 : 4.5)) found.add(`${element.tagName}.${element.className}: ${ratio.toFixed(2)}`);
  }
  return [n, [...found]];
}
