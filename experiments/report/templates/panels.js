// On a narrow screen the panels of a figure stand one below another: windows on the whole picture.
"use strict";
for (const picture of document.querySelectorAll("img[data-panels]")) {
  const parts = document.createElement("span");
  parts.className = "panels";
  parts.setAttribute("role", "img");
  parts.setAttribute("aria-label", picture.alt);
  for (const text of picture.dataset.panels.split(" ")) {
    // a panel; before it the labels of its axis, which are another panel's
    const boxes = text.split("+").map((box) => box.split(",").map(Number));
    const across = boxes.reduce((sum, [left, , right]) => sum + right - left, 0);
    const [, top, , bottom] = boxes.at(-1);
    const part = document.createElement("span");
    for (const [left, , right] of boxes) {
      part.insertAdjacentHTML("beforeend", `<svg viewBox="${left} ${top} ${right - left} ${bottom - top}"
        style="flex: ${right - left}"><image width="${picture.getAttribute("width")}"/></svg>`);
      part.lastChild.firstChild.setAttribute("href", picture.src);
    }
    // a panel has its own line, the entries of a legend share one
    const block = bottom - top > 60 ? "display: flex; margin: 0 auto;" : across < 300 ? "margin: 0 5px;" : "";
    // 0.4 of its size at least, where its letters are seven pixels high, and twelve at most
    part.style.cssText = `${block} width: clamp(${0.4 * across}px, 100%, ${0.75 * across}px)`;
    parts.append(part);
  }
  picture.after(parts);
}
