// On a narrow screen the panels of a figure stand one below another: windows on the whole picture.
"use strict";
for (const picture of document.querySelectorAll("img[data-panels]")) {
  const [width, height] = ["width", "height"].map((name) => Number(picture.getAttribute(name)));
  const parts = document.createElement("span");
  parts.className = "panels";
  parts.setAttribute("role", "img");
  parts.setAttribute("aria-label", picture.alt);
  for (const text of picture.dataset.panels.split(" ")) {
    // a panel; before it the labels of its axis, which are another panel's
    const boxes = text.split("+").map((box) => box.split(",").map(Number));
    const [, top, , bottom] = boxes[boxes.length - 1];
    const down = bottom - top;
    const across = boxes.reduce((sum, [left, , right]) => sum + right - left, 0);
    const part = document.createElement("span");
    // a panel has its own line, the entries of a legend share one
    const block = down > 60 ? "display: block; margin: 0 auto;" : across < 300 ? "margin: 0 5px;" : "";
    // 0.4 of its size at least, where its letters are seven pixels high, and twelve at most
    part.style.cssText = `${block} width: clamp(${0.4 * across}px, 100%, ${0.75 * across}px);
      aspect-ratio: ${across} / ${down}`;
    let at = 0;
    for (const [left, first, right, last] of boxes) {
      const pane = document.createElement("span");
      pane.style.cssText = `left: ${(100 * at) / across}%; width: ${(100 * (right - left)) / across}%;
        clip-path: inset(${(100 * (first - top)) / down}% 0 ${(100 * (bottom - last)) / down}% 0)`;
      const whole = new Image();
      whole.alt = "";
      whole.src = picture.src;
      whole.style.cssText = `width: ${(100 * width) / (right - left)}%; height: ${(100 * height) / down}%;
        left: ${(-100 * left) / (right - left)}%; top: ${(-100 * top) / down}%`;
      pane.append(whole);
      part.append(pane);
      at += right - left;
    }
    parts.append(part);
  }
  picture.after(parts);
}
